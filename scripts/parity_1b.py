"""Compares the full-size network with the original VGGT-1B on three frames, in float32.

    python scripts/parity_1b.py [--golden ../shared/golden]

The reference's weights are random and made from their names, so that no checkpoint is needed. Takes about two
minutes and 6 GB of memory on two cores; exits with 1 if a figure misses its bound.
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

# The bounds hold for float32 on a CPU.
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from logvggt_jax.config import ModelConfig, WindowConfig
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.parameters import run
from logvggt_jax.weights import params_from_vggt
from logvggt_jax.weights.lazy import LazyTensors

BOUND = 1e-5
SHARED = Path(os.environ.get("LOGVGGT_SHARED", Path(__file__).parents[2] / "shared"))


class Comparison(NamedTuple):
    """One output against the reference: norm of the difference over norm of the reference."""

    name: str
    error: float

    @property
    def ok(self) -> bool:
        return self.error <= BOUND


def compare(golden: Path) -> list[Comparison]:
    """Every output in `vggt_1b.npz` under `golden`, computed by the JAX network in one window of three frames."""
    with np.load(golden / "vggt_1b.npz") as arrays:
        reference = dict(arrays)
    config = ModelConfig(windows=WindowConfig(size=3, stride=1))
    params, _ = params_from_vggt(reference_weights(golden, "vggt_1b"), config)
    images = reference.pop("images_u8")[None]
    predictions = jax.device_get(jax.jit(LogVGGT(config).apply)({"params": params}, images))
    patches, layers = jax.device_get(_window_tokens(config, params, images))

    found = {
        "dino_patch_tokens": patches,
        **{f"agg_{layer:02d}": layers[0, i] for i, layer in enumerate(config.aggregator.key_layers)},
        **{f"pose_enc_iter{i}": predictions.pose_encodings[0, :, i] for i in range(config.camera_head.iterations)},
        "depth": predictions.depth[0, ..., None],
        "depth_conf": predictions.depth_confidence[0],
        "camera_tokens": predictions.camera_tokens[0],
        "register_tokens": predictions.register_tokens[0],
    }
    reference["camera_tokens"] = reference["agg_23"][:, 0]
    reference["register_tokens"] = reference["agg_23"][:, 1:5]
    return list(_comparisons(found, reference))


def reference_weights(golden: Path, model: str) -> LazyTensors:
    """Weights of the reference's `model` in PyTorch names and layouts, each made when it is read."""
    spec = importlib.util.spec_from_file_location("make_vggt_weights", golden / "make_vggt_weights.py")
    if spec is None or spec.loader is None:
        raise FileNotFoundError(f"{golden / 'make_vggt_weights.py'}: cannot be imported; give the golden folder")
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    shapes = maker.load_shapes(golden / f"{model}.json")
    return LazyTensors(list(shapes), lambda name: maker.make(name, shapes[name]))


@functools.partial(jax.jit, static_argnums=0)
def _window_tokens(config: ModelConfig, params: dict, images: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Patch tokens [T, h * w, C] and key-layer tokens [1, 4, T, P, 2C] of images [1, T, H, W, 3] as one window."""
    windows = LogVGGT(config).windows
    patches, first = windows.encode({"params": params}, images), jnp.ones(1, bool)
    grid = windows.grid(images.shape[2:4])
    tokens, _ = run(windows.aggregator, params["aggregator"], patches, None, first, None, grid=grid)
    return patches[0], tokens.key


def _comparisons(found: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> Iterator[Comparison]:
    for name, expected in reference.items():
        if found[name].shape != expected.shape:
            raise ValueError(f"{name} has shape {found[name].shape}, the reference {expected.shape}")
        difference = found[name].astype(np.float64) - expected
        yield Comparison(name, float(np.linalg.norm(difference) / np.linalg.norm(expected.astype(np.float64))))


def main() -> int:
    parser = argparse.ArgumentParser(description="Parity of the full-size network with the original VGGT-1B.")
    parser.add_argument("--golden", type=Path, default=SHARED / "golden", help="folder with vggt_1b.npz")
    golden = parser.parse_args().golden
    if not (golden / "vggt_1b.npz").is_file():
        parser.error(f"{golden / 'vggt_1b.npz'}: no such file; give the folder with --golden or set LOGVGGT_SHARED")
    start = time.perf_counter()
    comparisons = compare(golden)
    table = Table("output", "relative error", "bound", title="VGGT-1B, 3 frames of 70 x 98, float32")
    for comparison in comparisons:
        style = None if comparison.ok else "bold red"
        table.add_row(comparison.name, f"{comparison.error:.2e}", f"{BOUND:.0e}", style=style)
    console = Console()
    console.print(table)
    passed = all(comparison.ok for comparison in comparisons)
    console.print(f"{'passed' if passed else 'FAILED'} in {time.perf_counter() - start:.0f} s on {jax.devices()[0]}")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
