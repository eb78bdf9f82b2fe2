"""Masks on their way from the original pictures to the model's size."""

from __future__ import annotations

import numpy as np
from PIL import Image

from logvggt_jax.model.dinov2 import IMAGE_MEAN

# What masked pixels become, whatever they showed; before resizing, which mixes neighbours.
FILL = np.rint(255 * IMAGE_MEAN).astype(np.uint8)


def without_masked(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """An image [H, W, 3] uint8 with the pixels that `mask`, bool [H, W], drops in one colour."""
    return np.where(mask[..., None], image, FILL)


def mask_at(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask [H, W] at the size (h, w): a pixel counts if all that lies under it does."""
    levels = Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0)))
    return np.asarray(levels.resize(size[::-1], Image.Resampling.BOX)) == 255
