"""Resizing: model input from pictures of any size, and crops whose cameras follow.

Pixel centres are at integers; resizing by a factor s maps c' = (c + 0.5) s - 0.5. Images are resampled with the
antialiased bicubic filter (a = -0.5) of Pillow, which VGGT's weights were trained with; depth takes the nearest
pixel, since a mean across an edge is on neither surface.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from logvggt_jax.config import PATCH, check_longer_edge, check_size
from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames

LONGER_EDGE = 518
"""Pixels of the longer edge of VGGT's training images."""


@dataclass(frozen=True)
class ResizeTransform:
    """Maps between original pictures and the model input that `preprocess` made of them.

    Attributes:
      original_size: (H, W) of the originals.
      size: (h, w) of the model input.
    """

    original_size: tuple[int, int]
    size: tuple[int, int]

    @property
    def scale(self) -> np.ndarray:
        """[2] float64: w / W and h / H."""
        return np.array([self.size[1] / self.original_size[1], self.size[0] / self.original_size[0]])

    def pixels_to_original(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels [..., 2] (u, v) of the model input as pixels of the original."""
        return (np.asarray(pixels) + 0.5) / self.scale - 0.5

    def pixels_from_original(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels [..., 2] (u, v) of the original as pixels of the model input."""
        return (np.asarray(pixels) + 0.5) * self.scale - 0.5

    def intrinsics_to_original(self, intrinsics: np.ndarray) -> np.ndarray:
        """Intrinsics [..., 3, 3] for the model input's pixels as intrinsics for the original's."""
        return _rescaled(np.asarray(intrinsics), 1.0 / self.scale)

    def intrinsics_from_original(self, intrinsics: np.ndarray) -> np.ndarray:
        """Intrinsics [..., 3, 3] for the original's pixels as intrinsics for the model input's."""
        return _rescaled(np.asarray(intrinsics), self.scale)

    def depth_to_original(self, depth: np.ndarray) -> np.ndarray:
        """Depth or confidence [..., h, w] at the original size [..., H, W], nearest neighbour."""
        depth = np.asarray(depth)
        if depth.shape[-2:] != self.size:
            raise ValueError(f"depth must end in the model input's size {self.size}, got shape {depth.shape}")
        columns = _nearest(self.original_size[1], 1.0 / self.scale[0], 0.0, self.size[1])
        rows = _nearest(self.original_size[0], 1.0 / self.scale[1], 0.0, self.size[0])
        return depth[..., rows[:, None], columns]


def preprocess(
    frames: np.ndarray | Sequence[np.ndarray], *, longer_edge: int = LONGER_EDGE
) -> tuple[np.ndarray, ResizeTransform]:
    """Model input from pictures of any one size, and how to map results back.

    The longer edge becomes `longer_edge`, the other is rounded to the nearest multiple of 14 (ties to even, at
    least 14), so the aspect ratio changes by a little. Same rule and, to a grey level, same values as VGGT's loader
    in pad mode without its padding.

    Args:
      frames: uint8 RGB, [T, H, W, 3] or a sequence of [H, W, 3].
      longer_edge: pixels, a multiple of 14.

    Returns:
      Images [T, h, w, 3] float32 in [0, 1], and the transform.

    Raises:
      ValueError: wrong shape, dtype or `longer_edge`, no frames, or frames of unequal size.
    """
    frames = [np.asarray(frame) for frame in frames]
    if not frames:
        raise ValueError("no frames given: pass at least one uint8 picture [H, W, 3]")
    resized, transforms = zip(
        *(resize(frame, longer_edge=longer_edge, name=f"frame {index}") for index, frame in enumerate(frames)),
        strict=True,
    )
    for index, transform in enumerate(transforms):
        if transform != transforms[0]:
            raise ValueError(
                f"frame {index} has size {transform.original_size}, frame 0 has {transforms[0].original_size}: "
                "preprocess frames of one size at a time"
            )
    return np.stack(resized) / np.float32(255.0), transforms[0]


def resize(
    frame: np.ndarray, *, longer_edge: int = LONGER_EDGE, name: str = "the frame"
) -> tuple[np.ndarray, ResizeTransform]:
    """One frame [H, W, 3] uint8 RGB as `preprocess` resizes it, [h, w, 3], and how to map results back.

    `longer_edge` is in pixels, a multiple of 14; errors call the frame by its `name`. Raises ValueError for a wrong
    shape, dtype or `longer_edge`.
    """
    check_longer_edge(longer_edge)
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ValueError(f"{name} must be a uint8 RGB picture [H, W, 3], got {frame.dtype} with shape {frame.shape}")
    height, width = frame.shape[:2]
    if not height or not width:
        raise ValueError(f"{name} is empty: its size is {(height, width)}")
    rows, columns = resized_size((height, width), longer_edge)
    resized = Image.fromarray(frame).resize((columns, rows), Image.Resampling.BICUBIC)
    return np.asarray(resized), ResizeTransform(original_size=(height, width), size=(rows, columns))


def resized_size(size: tuple[int, int], longer_edge: int) -> tuple[int, int]:
    """(h, w) that `preprocess` gives to pictures of (H, W) pixels."""
    longer = max(size)
    rows, columns = (
        longer_edge if edge == longer else max(PATCH, PATCH * round(edge * longer_edge / longer / PATCH))
        for edge in size
    )
    return rows, columns


def nearest_size(size: tuple[int, int], sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """The one of `sizes` (H, W) whose aspect ratio is nearest to that of `size`; the first of equally near ones."""
    aspect = math.log(size[1] / size[0])
    return min(sizes, key=lambda each: abs(math.log(each[1] / each[0]) - aspect))


def fit(frames: Frames, size: tuple[int, int]) -> Frames:
    """`frames` cropped and resized to exactly `size` (H, W) with the principal point at (W/2, H/2).

    The crop is the largest with the target's aspect ratio whose principal point lands there; its borders need
    not fall on whole pixels, since images are resampled at the exact offset, so the intrinsics are exact as well.
    Pixel aspect is kept. Depth is sampled from the nearest pixel; depth values and extrinsics do not change.
    Frames that already fit are returned as they are.

    Raises:
      InputError: `size` is not two multiples of 14, or a principal point lies outside its image.
    """
    check_size(size, "size")
    source = frames.images.shape[1:3]
    if source == size and all(crop == (1.0, 0.0, 0.0) for crop in _crops(frames, size)):
        return frames
    count = len(frames.images)
    fitted = frames._replace(
        images=np.empty((count, *size, 3), np.uint8),
        depth=np.empty((count, *size), np.float32),
        intrinsics=np.empty((count, 3, 3), np.float32),
    )
    _fit_into(fitted, 0, frames, size)
    return fitted


def fit_each(frames: Iterable[Frames], count: int, size: tuple[int, int]) -> Frames:
    """`count` frames that arrive in parts, each fitted as by `fit` and then forgotten, as one new clip.

    Raises as `fit` does.
    """
    check_size(size, "size")
    clip = Frames(
        images=np.empty((count, *size, 3), np.uint8),
        depth=np.empty((count, *size), np.float32),
        intrinsics=np.empty((count, 3, 3), np.float32),
        extrinsics=np.empty((count, 4, 4), np.float32),
        metric=True,
    )
    done = 0
    for part in frames:
        _fit_into(clip, done, part, size)
        clip.extrinsics[done : done + len(part.images)] = part.extrinsics
        clip = clip._replace(metric=part.metric)
        done += len(part.images)
    return clip


def _fit_into(clip: Frames, first: int, frames: Frames, size: tuple[int, int]) -> None:
    """Writes `frames` as images, depth and intrinsics `first`, first + 1, … of `clip`."""
    height, width = size
    source_height, source_width = frames.images.shape[1:3]
    for index, (scale, left, top) in enumerate(_crops(frames, size)):
        place = first + index
        clip.intrinsics[place] = frames.intrinsics[index]
        if (source_height, source_width) == size and (scale, left, top) == (1.0, 0.0, 0.0):
            clip.images[place], clip.depth[place] = frames.images[index], frames.depth[index]
            continue
        # Only rounding can put a border outside the picture.
        right, bottom = min(left + width / scale, source_width), min(top + height / scale, source_height)
        box = (max(left, 0.0), max(top, 0.0), right, bottom)
        picture = Image.fromarray(frames.images[index])
        clip.images[place] = np.asarray(picture.resize((width, height), Image.Resampling.BICUBIC, box=box))
        rows = _nearest(height, scale, top, source_height)
        columns = _nearest(width, scale, left, source_width)
        # The mode spares a copy; all columns are inside.
        np.take(frames.depth[index][rows], columns, axis=1, out=clip.depth[place], mode="clip")
        clip.intrinsics[place, :2, :2] *= scale
        clip.intrinsics[place, :2, 2] = width / 2, height / 2


def _crops(frames: Frames, size: tuple[int, int]) -> list[tuple[float, float, float]]:
    source = (frames.images.shape[1], frames.images.shape[2])
    return [_crop(matrix, source, size) for matrix in frames.intrinsics.astype(np.float64)]


def _rescaled(intrinsics: np.ndarray, scale: np.ndarray) -> np.ndarray:
    result = intrinsics.astype(np.result_type(intrinsics, np.float32))
    result[..., :2, :2] *= scale[:, None]
    result[..., :2, 2] = (intrinsics[..., :2, 2] + 0.5) * scale - 0.5
    return result


def _crop(matrix: np.ndarray, source: tuple[int, int], size: tuple[int, int]) -> tuple[float, float, float]:
    """Scale, left and top of the crop: pixel c maps to (c - left + 0.5) scale - 0.5."""
    edges = (source[1], source[0])
    centre, target = matrix[:2, 2], np.array([size[1] / 2, size[0] / 2])
    before, after = centre + 0.5, np.array(edges) - 0.5 - centre
    if not (np.isfinite(centre).all() and (before > 0).all() and (after > 0).all()):
        raise InputError(
            f"the principal point ({centre[0]:g}, {centre[1]:g}) lies outside the image of size {source}: "
            "correct the intrinsics"
        )
    scale = float(max(np.max((target + 0.5) / before), np.max((target - 0.5) / after)))
    left, top = (float(c) for c in centre + 0.5 - (target + 0.5) / scale)
    return scale, left, top


def _nearest(out_size: int, scale: float, start: float, in_size: int) -> np.ndarray:
    centres = (np.arange(out_size) + 0.5) / scale + start
    return np.clip(np.floor(centres).astype(np.intp), 0, in_size - 1)
