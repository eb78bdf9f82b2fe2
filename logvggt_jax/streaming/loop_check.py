"""Whether two places of a sequence are one: what a prediction of both together says of what each has by itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from logvggt_jax.geometry import NoSimilarity, Similarity, project, unproject
from logvggt_jax.streaming.alignment import align, confident
from logvggt_jax.streaming.offline import PlainPrediction

# Points agree that differ by less than this share of their depth.
_SAME = 0.04
# The joint prediction must give each place the shape that it has by itself, in this share of its pixels.
_LEAST_SHAPE = 0.5
# Of each place's pixels this share must be seen from the other place, with the same depth.
_LEAST_OVERLAP = 0.25
# Of the pixels that the other place's cameras look at, this share must have the same depth; what is hidden has not.
_LEAST_AGREEMENT = 0.8


class LoopCheck(NamedTuple):
    """What is known of a candidate; shares of the pixels of the place that has less.

    Attributes:
      shape: pixels to which the joint prediction gives the place that they have by themselves, after alignment.
      overlap: pixels that the other place's cameras see at the same depth.
      agreement: the same, of those that lie in view of the other place's cameras.
      relative: carries the world as it is at the second place onto the world as it is at the first; None where the
        predictions cannot be aligned.
    """

    shape: float
    overlap: float
    agreement: float
    relative: np.ndarray | None

    @property
    def passed(self) -> bool:
        """Whether the two places are one."""
        return (
            self.relative is not None
            and self.shape >= _LEAST_SHAPE
            and self.overlap >= _LEAST_OVERLAP
            and self.agreement >= _LEAST_AGREEMENT
        )


def check_loop(joint: PlainPrediction, first: PlainPrediction, second: PlainPrediction) -> LoopCheck:
    """Compares one prediction of the frames of both places with those of each.

    Args:
      joint: of the first place's frames, then the second's, in any world and unit.
      first, second: of the same frames and pixels, in the world as the sequence has it so far.
    """
    count = len(first.depth)
    parts = [PlainPrediction(*(x[chosen] for x in joint[:4])) for chosen in (slice(None, count), slice(count, None))]
    try:
        with np.errstate(all="ignore"):  # of untrained models, whose lenses may have no field of view
            return _compared(parts, (first, second))
    except NoSimilarity:
        return LoopCheck(0.0, 0.0, 0.0, None)


def _compared(parts: Sequence[PlainPrediction], own: Sequence[PlainPrediction]) -> LoopCheck:
    """As `check_loop`; NoSimilarity where a place's predictions cannot be aligned."""
    carried = [align(*each) for each in zip(parts, own, strict=True)]
    shape = min(_same_shape(*each) for each in zip(parts, own, carried, strict=True))
    one_way, other_way = _seen_alike(parts[0], parts[1]), _seen_alike(parts[1], parts[0])
    relative = carried[0].matrix @ np.linalg.inv(carried[1].matrix)
    return LoopCheck(shape, min(one_way[0], other_way[0]), min(one_way[1], other_way[1]), relative)


def _same_shape(source: PlainPrediction, target: PlainPrediction, similarity: Similarity) -> float:
    """The share of the pixels known to both that `similarity` carries to their place."""
    valid = confident(source, target)
    clouds = [unproject(each.depth, each.intrinsics, each.extrinsics)[valid] for each in (source, target)]
    apart = np.linalg.norm(similarity.apply(clouds[0].astype(np.float64)) - clouds[1], axis=-1)
    return float((apart < _SAME * target.depth[valid]).mean())


def _seen_alike(source: PlainPrediction, target: PlainPrediction) -> tuple[float, float]:
    """Of the points that `source` sees, the share that some camera of `target` sees at the same depth; and of those in
    view of a camera, the share that it sees so, for the camera that agrees most."""
    valid = confident(source, source)
    points = unproject(source.depth, source.intrinsics, source.extrinsics)[valid]
    height, width = target.depth.shape[1:]
    pixels, depth = project(points[None], target.intrinsics, target.extrinsics)  # [n, N, 2], [n, N]
    u, v = (np.where(np.abs(x) < 1e6, np.round(x), -1).astype(int) for x in (pixels[..., 0], pixels[..., 1]))
    seen = (depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    frames = np.arange(len(target.depth))[:, None]
    there = target.depth[frames, np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
    alike = seen & (np.abs(there - depth) < _SAME * depth)
    total = max(seen.any(0).sum(), 1)
    return float(alike.any(0).mean()), float(alike.any(0).sum() / total)
