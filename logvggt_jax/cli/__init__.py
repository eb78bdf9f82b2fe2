"""The `logvggt` command: convert weights, reconstruct sequences, follow cameras, check data, look at results.

Commands import what they need when they run: JAX takes seconds to load, `--help` should not.
"""

from logvggt_jax.interruption import one_line_at_ctrl_c

with one_line_at_ctrl_c("logvggt"):
    from logvggt_jax.cli.program import main

__all__ = ["main"]
