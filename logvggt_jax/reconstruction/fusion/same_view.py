"""Whether a picture or depth map from elsewhere shows what a result's frames show, so that only its size differs."""

from __future__ import annotations

from logvggt_jax.reconstruction.result import Reconstruction

# By how much the aspect ratios of two pictures of one frame may differ.
_ASPECT = 0.01


def may_be_cut(result: Reconstruction) -> bool:
    """Whether frames may be parts of larger pictures (`--size-mismatch crop`)."""
    return result.source is not None and result.source.options.get("size_mismatch") == "crop"


def is_same_view(result: Reconstruction, size: tuple[int, int]) -> bool:
    """Whether what has `size` (H, W) is a frame enlarged or reduced.

    Where frames may be cut it has to have their size: what is larger may be the picture that one is a part of.
    """
    return size == result.image_size if may_be_cut(result) else _alike(size, result.image_size)


def lies_on_its_side(result: Reconstruction, size: tuple[int, int]) -> bool:
    """Whether what has `size` (H, W) has the shape of a frame that nobody has turned upright."""
    return _alike(size[::-1], result.image_size) and not _alike(size, result.image_size)


def _alike(size: tuple[int, int], other: tuple[int, int]) -> bool:
    return abs(size[1] * other[0] / (size[0] * other[1]) - 1) <= _ASPECT
