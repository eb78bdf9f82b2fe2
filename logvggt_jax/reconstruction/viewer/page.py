"""A reconstruction as one HTML file that opens in a browser without a server, a network or any other file."""

from __future__ import annotations

import base64
import html
import json
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from logvggt_jax.colours import depth_picture
from logvggt_jax.errors import InputError, OutputExists, disk_errors, printable
from logvggt_jax.files import check_writable, user_path, write_text
from logvggt_jax.frames import evenly_spaced
from logvggt_jax.geometry import camera_centres
from logvggt_jax.reconstruction.depth_files import IMAGE_FOLDER, encode_picture
from logvggt_jax.reconstruction.points.cloud_file import Cloud
from logvggt_jax.reconstruction.previews import depth_range
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.viewer.colouring import IMAGE, colourings, level_limits, palette, point_levels
from logvggt_jax.reconstruction.viewer.detail import Detail
from logvggt_jax.reconstruction.viewer.drawing import MOST_FRUSTA, camera_size
from logvggt_jax.reconstruction.viewer.opening_view import opening_view, point_spacing, scene_span

# Mail and forums take files of up to 25 MB.
MOST_BYTES = 24_500_000
# Steps of the scrubber, and the bytes for their pictures.
_MOST_STEPS, _PICTURE_BYTES = 150, 8_000_000
_PICTURE_WIDTHS = (320, 256, 192, 128, 96, 64)
# Positions are 16-bit numbers in a box: the middle of the cloud, grown by this share of its edges to every side.
_MARGIN = 2.0
_LEVELS = 65535
_SUFFIX = ".html"


def save_page(
    folder: str | Path, path: str | Path, *, overwrite: bool = False, most_bytes: int = MOST_BYTES
) -> tuple[int, int]:
    """Writes a page with points, cameras and small pictures of a reconstruction, thinned until it fits.

    Args:
      folder: output of `logvggt reconstruct`.
      path: the file, `….html`.
      overwrite: replace an earlier one.
      most_bytes: size of the file at most.

    Returns:
      The number of points on the page, and of the cloud.

    Raises:
      InputError: `folder` holds no reconstruction, a file of it is damaged, or `path` cannot be written.
      OutputExists: `path` exists.
    """
    result = Reconstruction.open(folder)
    path = user_path(path)
    if path.suffix.lower() not in (_SUFFIX, ".htm"):
        raise InputError(f"{path}: a page's name must end in {_SUFFIX}")
    with disk_errors(path):
        if path.is_dir():
            raise InputError(f"{path} is a folder: choose another name")
        if path.exists() and not overwrite:
            raise OutputExists(f"{path} exists: choose another name or pass --overwrite to replace it")
    check_writable(path.absolute())
    cloud = result.cloud()
    steps = np.array(evenly_spaced(result.num_frames, _MOST_STEPS))
    scene = _scene(result, cloud, steps) | {"pictures": _pictures(result, steps, min(_PICTURE_BYTES, most_bytes // 3))}
    template = resources.files("logvggt_jax.reconstruction.viewer").joinpath("page.html").read_text("utf-8")
    template = template.replace("{{title}}", html.escape(printable(result.folder.resolve().name)))
    room = most_bytes - len(template.encode()) - len(_json(scene)) - 1000
    # Bytes of a point in base64: position, colour and, where the cloud knows them, two levels and a step.
    each = (9 if cloud.frame is None else 13) * 4 / 3
    chosen = Detail(cloud).choose(max(int(room / each), 0))
    points = _points(result, cloud, chosen, steps, scene)
    write_text(path, template.replace("{{data}}", _json(scene | points)))
    return points["count"], len(cloud.points)


def _scene(result: Reconstruction, cloud: Cloud, steps: np.ndarray) -> dict[str, Any]:
    """All but the points and the pictures."""
    centres = camera_centres(result.extrinsics)
    view = opening_view(result.extrinsics, result.intrinsics, result.image_size, cloud.points)
    origin, size = _box(cloud.points)
    span = scene_span(cloud.points, centres)
    height, width = result.image_size
    return {
        "view": {
            "position": view.position.tolist(),
            "target": view.target.tolist(),
            "up": view.up.tolist(),
            "fieldOfView": view.field_of_view,
        },
        "span": span,
        "frustum": camera_size(centres[steps], span),
        "mostFrusta": MOST_FRUSTA,
        "origin": origin.tolist(),
        "size": size.tolist(),
        "path": centres.round(6).tolist(),
        "cameras": [
            {
                "name": printable(result.names[index]),
                "frame": index,
                "extrinsics": result.extrinsics[index].tolist(),
                "tangents": [
                    width / 2 / float(result.intrinsics[index, 0, 0]),
                    height / 2 / float(result.intrinsics[index, 1, 1]),
                ],
            }
            for index in steps.tolist()
        ],
        "colourings": list(colourings(cloud)),
        "palettes": {each: _base64(palette(each)) for each in colourings(cloud) if each != IMAGE},
        "frames": result.num_frames,
        "stored": len(cloud.points),
    }


def _points(
    result: Reconstruction, cloud: Cloud, chosen: np.ndarray, steps: np.ndarray, scene: dict[str, Any]
) -> dict[str, Any]:
    """The points as base64: arrays [n, …] one after the other, numbers of two bytes little-endian."""
    places = (cloud.points[chosen].astype(np.float64) - scene["origin"]) / scene["size"]
    inside = ((places >= 0) & (places <= 1)).all(axis=1)
    chosen, places = chosen[inside], places[inside]
    points: dict[str, Any] = {
        "count": len(chosen),
        "spacing": point_spacing(scene["span"], len(chosen)),
        "positions": _base64(np.rint(places * _LEVELS).astype("<u2")),
        "colours": _base64(cloud.colours[chosen]),
    }
    if cloud.frame is not None:
        for name in ("depth", "confidence"):
            limits = level_limits(name, cloud, chosen, result)
            points[name] = _base64(np.rint(255 * point_levels(name, cloud, chosen, result, limits)).astype(np.uint8))
        # A frame without a step of its own goes to the nearest that has one.
        middles = (steps[:-1] + steps[1:]) / 2
        points["steps"] = _base64(np.searchsorted(middles, cloud.frame[chosen]).astype("<u2"))
    return points


def _box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Low corner and edges, each [3] float64, of a box around all points but stray ones."""
    if not len(points):
        return np.zeros(3), np.ones(3)
    shown = points[:: max(1, len(points) // 100_000)].astype(np.float64)
    low, high = np.percentile(shown, (2, 98), axis=0)
    edges = high - low
    grown = _MARGIN * np.maximum(edges, 0.1 * edges.max())
    low = np.maximum(low - grown, points.min(0))
    high = np.minimum(high + grown, points.max(0))
    return low, np.maximum(high - low, 1e-9)


def _pictures(result: Reconstruction, steps: np.ndarray, most_bytes: int) -> list[dict[str, str]]:
    """Image and depth of every step as JPEG in base64, as large as fits."""
    near, far = depth_range(result)
    has_images = (result.folder / IMAGE_FOLDER).exists()  # results of earlier versions have none
    made: list[dict[str, str]] = []
    for width in _PICTURE_WIDTHS:
        made = []
        for index in steps.tolist():
            pictures = {"depth": depth_picture(result.depth(index), near=near, far=far)}
            if has_images:
                pictures["image"] = result.image(index)
            made.append({name: _jpeg(picture, width) for name, picture in pictures.items()})
            if sum(map(len, made[0].values())) * len(steps) > 2 * most_bytes:
                break  # a look at the first says that this is hopeless
        if len(made) == len(steps) and sum(len(text) for each in made for text in each.values()) <= most_bytes:
            break
    else:
        return []
    return made


def _jpeg(picture: np.ndarray, width: int) -> str:
    height = max(1, round(picture.shape[0] * width / picture.shape[1]))
    smaller = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    return base64.b64encode(encode_picture(".jpg", smaller)).decode()


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _json(value: object) -> str:
    """JSON that may stand in a page: nothing in it ends the element that it stands in."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
