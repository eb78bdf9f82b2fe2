"""Corners of a result's images, followed from frame to frame: depth says where to look, the images where they are."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from logvggt_jax.frames import evenly_spaced
from logvggt_jax.geometry import points_at, project
from logvggt_jax.reconstruction.exporters.cloud import tracked
from logvggt_jax.reconstruction.exporters.tracks import Tracks
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.result import Reconstruction

# Every so many frames corners are sought, so many at most.
_EVERY, _CORNERS = 2, 200
# They are looked for so many frames before and after, and in so many frames spread over the sequence, for loops.
_APART, _SPREAD = (1, 2, 3, 4, 6, 8, 12, 16), 16
_FEWEST = 3
# A corner is looked for where the depth is as expected to this share; poses that shall be mended are not exact.
_TOLERANCE = 0.2
# Around a corner on one surface depth differs less than by this factor; others are where two happen to cross.
_SURFACE, _AROUND = 1.08, 5
# Pixels: side of the patch that is compared, how far from where it began a corner may be found on the way back.
_PATCH, _RETURN = 11, 0.5
_LEVELS = 2
# Grey levels by which two patches may differ on average.
_DIFFERENCE = 15.0
_KEPT_IMAGES = 64


class _Corners(NamedTuple):
    """Corners of one frame: pixels [n, 2] float32 (u, v), points [n, 3] float64 in the world."""

    pixels: np.ndarray
    points: np.ndarray


class _Frames:
    """Images and depth of some frames of a result under given cameras."""

    def __init__(
        self,
        result: Reconstruction,
        frames: Sequence[int],
        extrinsics: np.ndarray,
        intrinsics: np.ndarray,
        scales: np.ndarray,
    ) -> None:
        self.extrinsics, self.intrinsics = extrinsics, intrinsics
        self._result, self._frames, self._scales = result, frames, scales
        self.image = functools.lru_cache(_KEPT_IMAGES)(self._image)
        self.depth = functools.lru_cache(_KEPT_IMAGES)(self._depth)

    def _image(self, place: int) -> np.ndarray:
        return cv2.cvtColor(self._result.image(self._frames[place]), cv2.COLOR_RGB2GRAY)

    def _depth(self, place: int) -> np.ndarray:
        return self._scales[place] * self._result.depth(self._frames[place])

    def depth_at(self, place: int, pixels: np.ndarray) -> np.ndarray:
        """Depth [n] at the nearest pixels; `pixels` [n, 2] lie in the image."""
        u, v = np.rint(pixels).astype(int).T
        return self.depth(place)[v, u]


def follow_corners(
    result: Reconstruction,
    frames: Sequence[int],
    extrinsics: np.ndarray,
    intrinsics: np.ndarray,
    scales: np.ndarray,
    *,
    progress: bool,
) -> Tracks:
    """Points and where the images show them; each is seen by at least three frames.

    A corner's depth and the cameras say where another frame should show it; there Lucas and Kanade's method finds it to
    a fraction of a pixel. It counts if the way back leads to where it began. Arguments are those of `bundle_adjust`;
    the tracks' frames are places in `frames`, their points are black.
    """
    views = _Frames(result, frames, extrinsics, intrinsics, scales)
    count = len(frames)
    starts = range(0, count, _EVERY)
    spread = set(evenly_spaced(count, _SPREAD))
    points, places, indices, pixels = [], [], [], []
    total = 0
    with FramePool() as pool:
        found = pool.map(lambda start: list(_from_frame(views, start, count, spread)), iter(starts))
        for sightings in tracked(found, "Corners", len(starts), progress=progress):
            (corners, *others) = sightings
            seen = np.zeros(len(corners[1]), int)
            for _, which, _ in others:
                seen[which] += 1
            kept = seen >= _FEWEST - 1
            number = np.cumsum(kept) - 1 + total
            points.append(corners[2][kept])
            for place, which, where in [(corners[0], np.arange(len(seen)), corners[1]), *others]:
                use = kept[which]
                places.append(np.full(int(use.sum()), place))
                indices.append(number[which[use]])
                pixels.append(where[use])
            total += int(kept.sum())
    frame_of, index_of = np.concatenate(places), np.concatenate(indices)
    order = np.argsort(frame_of, kind="stable")
    colours = np.zeros((total, 3), np.uint8)
    where = np.concatenate(pixels)[order].astype(np.float64)
    return Tracks(np.concatenate(points), colours, frame_of[order], index_of[order], where)


def _from_frame(views: _Frames, start: int, count: int, spread: set[int]) -> Iterator[tuple]:
    """First (start, pixels, points) of the corners of a frame, then (place, which, pixels) for each other frame."""
    corners = _corners(views, start)
    yield start, corners.pixels, corners.points
    near = {start + sign * apart for apart in _APART for sign in (-1, 1)}
    for place in sorted((near | spread) - {start}):
        if 0 <= place < count and len(corners.pixels):
            which, where = _find(views, start, corners, place)
            if len(which):
                yield place, which, where


def _corners(views: _Frames, place: int) -> _Corners:
    found = cv2.goodFeaturesToTrack(views.image(place), _CORNERS, qualityLevel=0.01, minDistance=5)
    pixels = np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)
    depth = views.depth_at(place, pixels).astype(np.float64)
    surface, around = np.nan_to_num(views.depth(place)), np.ones((_AROUND, _AROUND), np.uint8)
    u, v = np.rint(pixels).astype(int).T
    least, most = (change(surface, around)[v, u] for change in (cv2.erode, cv2.dilate))
    valid = np.isfinite(depth) & (least > 0) & (most < _SURFACE * least)
    pixels, depth = pixels[valid], depth[valid]
    return _Corners(pixels, points_at(pixels, depth, views.intrinsics[place], views.extrinsics[place]))


def _find(views: _Frames, start: int, corners: _Corners, place: int) -> tuple[np.ndarray, np.ndarray]:
    """Which corners another frame shows, and where."""
    image, other = views.image(start), views.image(place)
    height, width = image.shape
    expected, depth = project(corners.points, views.intrinsics[place], views.extrinsics[place])
    with np.errstate(invalid="ignore"):
        inside = (depth > 0) & ((expected >= 0) & (expected <= [width - 1, height - 1])).all(-1)
    which = np.flatnonzero(inside)
    there = views.depth_at(place, expected[which])
    which = which[np.abs(there - depth[which]) < _TOLERANCE * depth[which]]
    if not len(which):
        return which, np.zeros((0, 2), np.float32)
    options: dict[str, Any] = {
        "winSize": (_PATCH, _PATCH),
        "maxLevel": _LEVELS,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.001),
    }
    begun = corners.pixels[which]
    guess = expected[which].astype(np.float32)
    where, good, difference = cv2.calcOpticalFlowPyrLK(image, other, begun, guess.copy(), **options)
    # The way back begins as far off as the way there did.
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, image, where, begun + (where - guess), **options)
    close = np.linalg.norm(back - begun, axis=1) < _RETURN
    use = (good[:, 0] > 0) & (returned[:, 0] > 0) & close & (difference[:, 0] < _DIFFERENCE)
    return which[use], where[use]
