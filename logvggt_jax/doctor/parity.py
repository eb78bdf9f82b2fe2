"""A small network against recorded values: does this machine compute the model?"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import resources
from typing import Any

import jax
import numpy as np

from logvggt_jax.doctor.finding import Finding
from logvggt_jax.doctor.subject import random_variables, tiny_config
from logvggt_jax.model.logvggt import LogVGGT

RECORDED = "parity.npz"
FRAMES, IMAGE_SIZE = 7, (28, 42)
# Largest norm of the difference over that of the reference without its mean (a depth map is mostly its mean). Rounding
# alone is about 1e-6 in float32 and 1e-2 in bfloat16.
# Dense maps vary little in this network, so that bfloat16's rounding is a few parts in a hundred of it: 0.029 on a CPU.
_DENSE_BFLOAT16 = 1e-1
# Accelerators sum products in another order than the CPU on which the values were recorded.
_BOUNDS = {"cpu": {"float32": 1e-5, "bfloat16": 3e-2}, "accelerator": {"float32": 1e-4, "bfloat16": 3e-2}}
_OUTPUTS = ("pose_encodings", "depth", "depth_confidence", "camera_tokens", "register_tokens")


def outputs(dtype: str) -> dict[str, np.ndarray]:
    """The small network's outputs on this machine, every pixel or token of a few."""
    model = LogVGGT(tiny_config(dtype))
    images = np.random.default_rng(1).integers(0, 256, (1, FRAMES, *IMAGE_SIZE, 3), np.uint8)
    predictions: Any = jax.jit(model.apply)(random_variables(model, scale=0.1), images)
    found = {name: np.asarray(getattr(predictions, name)) for name in _OUTPUTS}
    # Dense maps are recorded at some pixels, so that the file stays small.
    return {name: value[..., ::5, ::5] if name.startswith("depth") else value for name, value in found.items()}


def examine() -> Iterator[Finding]:
    """Errors of every output in float32 and bfloat16."""
    with resources.files("logvggt_jax.doctor").joinpath(RECORDED).open("rb") as file:
        recorded = dict(np.load(file, allow_pickle=False))
    for dtype, bound in _BOUNDS["cpu" if jax.default_backend() == "cpu" else "accelerator"].items():
        found = outputs(dtype)
        for name, expected in recorded.items():
            at_most = _DENSE_BFLOAT16 if dtype == "bfloat16" and name.startswith("depth") else bound
            error = float(np.linalg.norm(found[name] - expected) / np.linalg.norm(expected - expected.mean()))
            yield Finding("parity", f"{name}, {dtype}", error, ok=bool(error <= at_most), note=f"at most {at_most:g}")
