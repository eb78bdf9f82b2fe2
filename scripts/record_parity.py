"""Records what `logvggt doctor` compares a machine with: outputs of a small network in float32 on this CPU.

    JAX_PLATFORMS=cpu python scripts/record_parity.py

To be run again when the network's numbers change for a reason; the parity tests with VGGT say whether they may.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import logvggt_jax.doctor
from logvggt_jax.doctor.parity import RECORDED, outputs

if __name__ == "__main__":
    path = Path(logvggt_jax.doctor.__path__[0]) / RECORDED
    np.savez_compressed(path, **outputs("float32"))
    print(f"{path}: {path.stat().st_size:,} bytes")
