"""Parameters at 16 bits in one safetensors file, as models that ship with the package have them."""

from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np
from safetensors.numpy import save

from logvggt_jax.weights.digests import named_leaves
from logvggt_jax.weights.files import open_safetensors

PARAMETERS_FILE = "params.safetensors"
_TYPES = (np.dtype(np.float16), np.dtype(ml_dtypes.bfloat16))


def rounded(params: Any) -> tuple[dict[str, np.ndarray], float]:
    """A parameter tree by names (`encoder/norm/scale`) in the 16-bit type that changes it least, and that change.

    The change is the norm of the difference over the norm of the parameters. float16 has three more bits of mantissa,
    bfloat16 takes values beyond 65,504 and below 6e-8.
    """
    leaves = {name: np.asarray(leaf, np.float32) for name, leaf in named_leaves(params)}
    norm = np.sqrt(sum(np.square(leaf, dtype=np.float64).sum() for leaf in leaves.values()))

    def change(dtype: np.dtype) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            differences = [leaf.astype(dtype).astype(np.float64) - leaf for leaf in leaves.values()]
        return float(np.sqrt(sum(np.square(each).sum() for each in differences)) / norm)

    changes = {dtype: change(dtype) for dtype in _TYPES}
    best = min(changes, key=changes.__getitem__)
    return {name: leaf.astype(best) for name, leaf in leaves.items()}, changes[best]


def write_parameters(folder: Path, leaves: dict[str, np.ndarray]) -> None:
    """Writes what `rounded` gave into a model folder."""
    (folder / PARAMETERS_FILE).write_bytes(save(leaves))


def read_parameters(folder: Path) -> dict[str, np.ndarray]:
    """The parameters of a model folder that has them in this form, by name, float32.

    Raises InputError where the file is damaged, as far as it tells: digests tell the rest.
    """
    with open_safetensors(folder / PARAMETERS_FILE) as tensors:
        return {name: np.asarray(tensors[name]).astype(np.float32) for name in tensors}
