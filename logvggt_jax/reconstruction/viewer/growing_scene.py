"""The scene of a run that goes on: a few points of every frame, within bounds however long it takes."""

from __future__ import annotations

import dataclasses
import math
import threading
from typing import NamedTuple

import numpy as np

from logvggt_jax.geometry import decode_poses
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.watching import LiveResult

# All points together, and the frames that they are from.
MOST_POINTS, MOST_FRAMES = 300_000, 1_000
# Points of a frame at first.
_SHARE = 8_000
# Pixels that are looked at for each point that is wanted.
_LOOK_AHEAD = 4
_FILTER = PointFilter()


@dataclasses.dataclass
class _Frame:
    """Points of a frame in an order of chance: rays [n, 2] (x, y) in tangents by the field of view's edge, z-depth [n]
    and colours [n, 3] uint8; its pose, once it has one."""

    rays: np.ndarray
    depth: np.ndarray
    colours: np.ndarray
    encoding: np.ndarray | None

    def shortened(self, count: int) -> _Frame:
        """The first points alone; copies, so that the others are let go."""
        return _Frame(self.rays[:count].copy(), self.depth[:count].copy(), self.colours[:count].copy(), self.encoding)


class Scene(NamedTuple):
    """What there is to be drawn.

    Attributes:
      points: [M, 3] float32 in the world.
      colours: [M, 3] uint8.
      extrinsics: [N, 3, 4] float64, world-to-camera (OpenCV), of the frames with a pose that are kept and the newest.
      intrinsics: [N, 3, 3] in pixels of images of `image_size`.
      image_size: (h, w).
      num_frames: frames that became final so far.
      newest: the last of them.
      newest_is_placed: whether its camera is among these, as the last.
    """

    points: np.ndarray
    colours: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    image_size: tuple[int, int]
    num_frames: int
    newest: LiveResult
    newest_is_placed: bool


class GrowingScene:
    """Takes frames as they become final and keeps a few points of each.

    At first that are many a frame. When there are more than `most_points` each frame gives back half of its own, and
    when they are too few to be halved again, every second frame goes, and of those to come only each second, fourth, …
    is taken: at any time all of the sequence is shown alike. Any thread may call any method.

    Args:
      most_points: of all frames together.
      most_frames: that points are kept of.
    """

    def __init__(self, most_points: int = MOST_POINTS, most_frames: int = MOST_FRAMES) -> None:
        self._most_points, self._most_frames = most_points, most_frames
        self._share, self._step = min(_SHARE, most_points), 1
        self._frames: dict[int, _Frame] = {}
        self._newest: LiveResult | None = None
        self._newest_pose: np.ndarray | None = None
        self._count = 0
        self._lock = threading.Lock()

    def add(self, frame: LiveResult) -> None:
        """The next frame. Looks at some thousand of its pixels, whatever its size."""
        index, pose = frame.result.index, frame.result.pose_encoding
        with self._lock:
            self._count = index + 1
            self._newest, self._newest_pose = frame, pose
            if index % self._step:
                return
            self._frames[index] = _sampled(frame, self._share)
            while len(self._frames) * self._share > self._most_points or len(self._frames) > self._most_frames:
                self._thin()

    def place(self, pose_encodings: np.ndarray) -> None:
        """Pose encodings [N, 9] of the first N frames."""
        with self._lock:
            for index, frame in self._frames.items():
                if index < len(pose_encodings):
                    frame.encoding = pose_encodings[index]
            if self._count <= len(pose_encodings):
                self._newest_pose = pose_encodings[self._count - 1]

    def scene(self) -> Scene | None:
        """What is to be drawn now; None before the first frame with a pose."""
        with self._lock:  # arrays are never changed, so that a list of them is enough
            placed = [(frame.encoding, frame) for frame in self._frames.values() if frame.encoding is not None]
            newest, count, pose = self._newest, self._count, self._newest_pose
            between = None if count - 1 in self._frames else pose
        if newest is None or not placed:
            return None
        encodings = [encoding for encoding, _ in placed]
        if between is not None:
            encodings.append(between)
        size = newest.image.shape[0], newest.image.shape[1]
        with np.errstate(all="ignore"):  # models that are not trained give any number
            extrinsics, intrinsics = decode_poses(np.stack(encodings).astype(np.float64), size)
            points = [_placed(frame, extrinsics[i], encodings[i]) for i, (_, frame) in enumerate(placed)]
            found, colours = np.concatenate(points), np.concatenate([frame.colours for _, frame in placed])
        finite = np.isfinite(found).all(axis=1)
        whole = np.isfinite(extrinsics).all((1, 2)) & np.isfinite(intrinsics).all((1, 2))
        if not whole.any():
            return None
        is_placed = pose is not None and bool(whole[-1])
        return Scene(
            found[finite], colours[finite], extrinsics[whole], intrinsics[whole], size, count, newest, is_placed
        )

    def _thin(self) -> None:
        if self._share > max(self._most_points // self._most_frames, 1):
            self._share = max(self._share // 2, 1)
            self._frames = {index: frame.shortened(self._share) for index, frame in self._frames.items()}
        else:
            self._step *= 2
            self._frames = {index: frame for index, frame in self._frames.items() if index % self._step == 0}


def _sampled(frame: LiveResult, count: int) -> _Frame:
    """Up to `count` points as `PointFilter` chooses them, of a grid over the frame, no finer than it must be."""
    depth, confidence = frame.result.depth, frame.result.confidence
    generator = np.random.default_rng(frame.result.index)
    height, width = depth.shape
    step = max(1, math.isqrt(depth.size // (_LOOK_AHEAD * count)))
    first = generator.integers(step, size=2)
    grid = slice(first[0], None, step), slice(first[1], None, step)
    depth, confidence, image = depth[grid], confidence[grid], frame.image[grid]
    rows, columns = np.nonzero(_FILTER.candidates(depth, confidence))
    if len(rows):
        sure = confidence[rows, columns]
        sure = sure >= np.percentile(sure, _FILTER.confidence_percentile)
        rows, columns = rows[sure], columns[sure]
    chosen = generator.permutation(len(rows))[:count]
    rows, columns = rows[chosen], columns[chosen]
    x = (first[1] + step * columns) / (width / 2) - 1
    y = (first[0] + step * rows) / (height / 2) - 1
    rays = np.stack([x, y], axis=-1).astype(np.float32)
    return _Frame(rays, depth[rows, columns].astype(np.float32), image[rows, columns], frame.result.pose_encoding)


def _placed(frame: _Frame, extrinsics: np.ndarray, encoding: np.ndarray) -> np.ndarray:
    """The frame's points [n, 3] float32 in the world."""
    tangents = np.tan(encoding[8:6:-1].astype(np.float64) / 2)  # the principal point is the image's middle
    in_camera = np.concatenate([frame.rays * tangents, np.ones((len(frame.rays), 1))], axis=1) * frame.depth[:, None]
    return ((in_camera - extrinsics[:, 3]) @ extrinsics[:, :3]).astype(np.float32)
