"""The rows of the model itself, one for each method of running it."""

from __future__ import annotations

from collections.abc import Sequence

from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.methods.method import Checkpoint, Method, network
from logvggt_jax.evaluation.methods.references import ReferenceConfig, chunked_vggt, offline_vggt

METHODS = ("windows", "offline", "chunks")


def model_rows(checkpoint: Checkpoint, names: Sequence[str], limits: ReferenceConfig) -> list[Method]:
    """One row for each named method, all on the same parameters.

    Raises:
      InputError: an unknown name.
    """
    for name in names:
        if name not in METHODS:
            raise InputError(f"config.methods: unknown {name!r}; known are {', '.join(METHODS)}")
    made = {
        "windows": lambda: network(checkpoint),
        "offline": lambda: offline_vggt(checkpoint, limits),
        "chunks": lambda: chunked_vggt(checkpoint, limits),
    }
    return [made[name]() for name in names]
