"""Whether a picture or depth map from elsewhere shows what a result's frames show, so that only its size differs."""

from __future__ import annotations

from logvggt_jax.frames import same_proportions
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
    if may_be_cut(result):
        return size == result.image_size
    return same_proportions(size, result.image_size, _ASPECT)


def lies_on_its_side(result: Reconstruction, size: tuple[int, int]) -> bool:
    """Whether what has `size` (H, W) has the shape of a frame that nobody has turned upright."""
    upright, turned = (same_proportions(each, result.image_size, _ASPECT) for each in (size, size[::-1]))
    return turned and not upright
