"""What a model makes of a clip, as pictures: depth with its errors, and the way of the camera."""

import cv2
import numpy as np

from logvggt_jax.colours import coloured, depth_limits, depth_picture
from logvggt_jax.frames import Frames, evenly_spaced
from logvggt_jax.geometry import camera_centres, relative_to_first

_FRAMES = 4
_TILE_WIDTH = 160
_HEADER = 18
_SIDE = 320
_MARGIN = 24
_LARGEST_ERROR = 0.5
_BLACK, _ORANGE, _WHITE = (0, 0, 0), (230, 100, 0), (255, 255, 255)


def clip_picture(clip: Frames, depth: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Some frames of a clip, one below the other: input, true depth, predicted depth, error, confidence.

    Both depths have the scale of the true one, from its 2nd to its 98th percentile, after alignment of the medians;
    the error is relative to the true depth, black where that is not known. What is on each side of a scale is written
    above.

    Args:
      clip: T frames of H x W.
      depth: [T, H, W], predicted, in any unit.
      confidence: [T, H, W], at least 1.

    Returns:
      [h, w, 3] uint8 RGB.
    """
    valid = clip.depth > 0
    near, far = depth_limits(clip.depth)
    with np.errstate(all="ignore"):  # a model may have lost its numbers, and is looked at all the more
        ratio = np.median(clip.depth[valid]) / np.median(depth[valid]) if valid.any() else 1.0
        aligned = ratio * depth
        error = np.where(valid, np.abs(aligned - clip.depth) / np.where(valid, clip.depth, 1.0), np.nan)
        sure = np.log(confidence)
    finite = sure[np.isfinite(sure)]
    most = max(float(finite.max(initial=0.0)), 1e-6)
    titles = (
        "input",
        f"true, {near:.3g} to {far:.3g}{' m' if clip.metric else ''}",
        "predicted",
        f"error, 0 to {_LARGEST_ERROR:.0%}",
        f"confidence, 1 to {np.exp(most):.3g}",
    )
    chosen = evenly_spaced(len(depth), _FRAMES)
    rows = [
        np.concatenate(
            [
                _tile(clip.images[i]),
                _tile(depth_picture(clip.depth[i], near=near, far=far)),
                _tile(depth_picture(aligned[i], near=near, far=far)),
                _tile(coloured(error[i] / _LARGEST_ERROR)),
                _tile(coloured(sure[i] / most)),
            ],
            axis=1,
        )
        for i in chosen
    ]
    header = np.full((_HEADER, rows[0].shape[1], 3), 255, np.uint8)
    for column, title in enumerate(titles):
        _write(header, title, (column * rows[0].shape[1] // len(titles) + 3, _HEADER - 5), _BLACK)
    return np.concatenate([header, *rows])


def trajectory_picture(extrinsics: np.ndarray, true_extrinsics: np.ndarray) -> np.ndarray:
    """The camera's way seen from above, x to the right and z upwards in the first camera's frame: true and predicted.

    The predicted one has the unit that brings it nearest to the true one; nothing else is aligned.

    Args:
      extrinsics: [T, 3|4, 4] world-to-camera, in any unit.
      true_extrinsics: [T, 3|4, 4] world-to-camera.

    Returns:
      [h, h, 3] uint8 RGB.
    """
    true, found = (
        camera_centres(relative_to_first(np.asarray(poses, np.float64)))[:, [0, 2]]
        for poses in (true_extrinsics, extrinsics)
    )
    with np.errstate(all="ignore"):
        scale = (true * found).sum() / (found**2).sum()
    ways = [(true, _BLACK, "true")]
    if np.isfinite(scale * found).all():
        ways.append((scale * found, _ORANGE, "predicted"))
    points = np.concatenate([way for way, *_ in ways])
    low, extent = points.min(0), max(float(np.ptp(points, axis=0).max()), 1e-9)
    middle = low + np.ptp(points, axis=0) / 2
    picture = np.full((_SIDE, _SIDE, 3), 255, np.uint8)
    for number, (way, colour, name) in enumerate(ways):
        placed = (way - middle) / extent * (_SIDE - 2 * _MARGIN) * (1, -1) + _SIDE / 2
        corners = placed.round().astype(np.int32)
        cv2.polylines(picture, [corners[:, None]], isClosed=False, color=colour, lineType=cv2.LINE_AA)
        for corner in corners:
            cv2.circle(picture, tuple(int(x) for x in corner), 2, colour, cv2.FILLED)
        _write(picture, name, (4 + 60 * number, _SIDE - 6), colour)
    _write(picture, f"{extent:.3g} wide", (4, 14), _BLACK)
    return picture


def _tile(image: np.ndarray) -> np.ndarray:
    """A picture [H, W, 3] at a whole multiple of its size, wide enough for what is written above it."""
    times = max(-(-_TILE_WIDTH // image.shape[1]), 1)
    return image.repeat(times, axis=0).repeat(times, axis=1)


def _write(picture: np.ndarray, text: str, place: tuple[int, int], colour: tuple[int, int, int]) -> None:
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.35, colour, lineType=cv2.LINE_AA)
