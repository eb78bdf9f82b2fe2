"""Frames and their masks on their way from the original pictures to the model's size."""

from __future__ import annotations

import numpy as np
from PIL import Image

from logvggt_jax.data.feeding.transforms import ResizeTransform, resize
from logvggt_jax.model.dinov2 import IMAGE_MEAN

# What masked pixels become, whatever they showed; before resizing, which mixes neighbours.
FILL = np.rint(255 * IMAGE_MEAN).astype(np.uint8)


def resized(
    image: np.ndarray, mask: np.ndarray | None, *, longer_edge: int
) -> tuple[np.ndarray, np.ndarray | None, ResizeTransform]:
    """What the model is given of a frame uint8 [H, W, 3] and of its mask, bool [H, W], True where it counts, if any.

    Returns:
      The frame [h, w, 3] without what is masked, its mask [h, w], and how they follow from the original.
    """
    if mask is None:
        image, transform = resize(image, longer_edge=longer_edge)
        return image, None, transform
    image, transform = resize(without_masked(image, mask), longer_edge=longer_edge)
    return image, mask_at(mask, transform.size), transform


def without_masked(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """An image [H, W, 3] uint8 with the pixels that `mask`, bool [H, W], drops in one colour."""
    return np.where(mask[..., None], image, FILL)


def mask_at(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask [H, W] at the size (h, w): a pixel counts if all that lies under it does."""
    levels = Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0)))
    return np.asarray(levels.resize(size[::-1], Image.Resampling.BOX)) == 255
