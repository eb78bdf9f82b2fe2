"""All numbers of a sequence's cameras on disk, as JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from reprlib import repr as shown  # short, however large or deep the value is
from typing import Any

import numpy as np

from logvggt_jax.config import from_mapping
from logvggt_jax.errors import InputError, MissingInput
from logvggt_jax.files import read_json, write_text
from logvggt_jax.geometry import LARGEST_ENTRY, is_rotation
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.sources.record import SourceRecord

CAMERAS_FILE = "cameras.json"
# What a result's folder is called beside its name until its run has ended.
PARTIAL = ".partial"
CAMERAS_FORMAT = "logvggt-cameras-1"


def write_cameras(
    path: str | Path,
    *,
    names: Sequence[str],
    timestamps: Sequence[float],
    extrinsics: np.ndarray,
    intrinsics: np.ndarray,
    image_size: tuple[int, int],
    model_intrinsics: np.ndarray,
    model_size: tuple[int, int],
    complete: bool = True,
    skipped: Sequence[tuple[str, str]] = (),
    noted_focal_length: float | None = None,
    source: SourceRecord | None = None,
    metric: bool = False,
    world_is_given: bool = False,
    depth_scale: np.ndarray | None = None,
    loops: np.ndarray | None = None,
    masked: Sequence[float] | None = None,
    timed: bool | None = None,
    point_filter: PointFilter | None = None,
) -> None:
    """Writes all cameras as one JSON file.

    Args:
      path: the JSON file.
      names: N frame names, those of the depth files.
      timestamps: N numbers.
      extrinsics: [N, 3, 4], world-to-camera.
      intrinsics: [N, 3, 3], pixels of the original images.
      image_size: (H, W) of the original images.
      model_intrinsics: [N, 3, 3], pixels of the depth maps.
      model_size: (H, W) of the depth maps.
      complete: whether the sequence was read to its end.
      skipped: frames that could not be read, with the reason.
      noted_focal_length: pixels of the original images, the median of what the camera noted; None where it is not
        known.
      source: where the frames came from; None where they cannot be read again.
      metric: whether lengths are metres.
      world_is_given: whether the world is that of poses from elsewhere, and not the first camera's frame.
      depth_scale: [N], by which the depth files' depth has to be multiplied to fit the cameras; None where it fits.
      loops: int [L, 2], the frames at which the sequence came back to a place; None where nobody looked for them.
      masked: [N], the share of the depth maps' pixels that a mask drops; None where there were no masks.
      timed: whether time stamps are seconds, and not positions; None where that is not known.
      point_filter: which pixels became points; None for `PointFilter`'s defaults.
    """
    frames: list[dict[str, Any]] = [
        {
            "name": name,
            "timestamp": float(timestamp),
            "extrinsics": extrinsics[i].tolist(),
            "intrinsics": intrinsics[i].tolist(),
            "depth_intrinsics": model_intrinsics[i].tolist(),
            **({} if depth_scale is None else {"depth_scale": float(depth_scale[i])}),
            **({} if masked is None else {"masked": round(masked[i], 4)}),
        }
        for i, (name, timestamp) in enumerate(zip(names, timestamps, strict=True))
    ]
    document = {
        "format": CAMERAS_FORMAT,
        "conventions": "extrinsics [3, 4] are world-to-camera, OpenCV axes (x right, y down, z forward); the world "
        "is the first camera's frame as the model estimates it, or that of the poses that were fused in; lengths are "
        "metres where metric is true, else up to one common scale; intrinsics are in pixels of the original images, "
        "depth_intrinsics in pixels of the depth maps; pixel centres lie at integers"
        + ("" if depth_scale is None else "; depth is the depth files' times depth_scale"),
        "image_size": list(image_size),
        "depth_size": list(model_size),
        "metric": metric,
        **({"world_is_given": True} if world_is_given else {}),
        **({} if timed is None else {"timed": timed}),
        "complete": complete,
        "noted_focal_length": noted_focal_length,
        "source": None if source is None else source._asdict(),
        **({} if loops is None else {"loops": loops.tolist()}),
        "points": dataclasses.asdict(point_filter or PointFilter()),
        "skipped": [{"name": name, "reason": reason} for name, reason in skipped],
        "frames": frames,
    }
    write_text(path, json.dumps(document, indent=1) + "\n")


def is_complete(path: Path) -> bool:
    """Whether a cameras file is there that does not say that its run was ended early."""
    try:
        return json.loads(path.read_text("utf-8")).get("complete", True) is True
    except (OSError, ValueError, AttributeError, RecursionError):
        return False


def read_cameras(path: str | Path) -> dict[str, Any]:
    """Inverse of `write_cameras`: the document, with the frames' matrices as float64 arrays, the source's
    record and the point filter.

    What is returned can be relied on: sizes are positive; names differ, are names of files and lead out of no folder;
    numbers are finite, also in float32; rotations are rotations; focal lengths are not zero.

    Raises:
      FileNotFoundError: no such file.
      ValueError: not a file that `write_cameras` has written, or damaged; says what and where.
    """
    path = Path(path)
    try:
        document = read_json(path, "so it is not a cameras file of this program, or damaged")
    except MissingInput:
        raise MissingInput(
            f"{path} does not exist: expected the output of `logvggt reconstruct`{_unfinished(path.parent)}"
        ) from None
    try:
        return _checked(document)
    except _Fault as fault:
        raise InputError(f"{path} is not a cameras file of this program, or damaged: {fault}") from None


def _unfinished(folder: Path) -> str:
    """A word on a run that has not ended and was to make this folder, or whose own it is; or nothing."""
    folder = folder.absolute()
    partial = folder if folder.name.endswith(PARTIAL) else folder.with_name(folder.name + PARTIAL)
    if not partial.is_dir():
        return ""
    return f"; {partial} is what a run has left that has not ended: the same command goes on with it"


class _Fault(Exception):
    """What is wrong with a document, without the file's name."""


def _checked(document: Any) -> dict[str, Any]:
    _require(isinstance(document, dict), "it holds no object")
    kind = document.get("format")
    other = isinstance(kind, str) and kind.startswith(CAMERAS_FORMAT.rstrip("1234567890"))
    which = ": it is of another version of this program" if other and kind != CAMERAS_FORMAT else ""
    _require(kind == CAMERAS_FORMAT, f"it has format {shown(kind)}, expected {CAMERAS_FORMAT!r}{which}")
    for key in ("image_size", "depth_size"):
        size = document.get(key)
        valid = isinstance(size, list) and len(size) == 2 and all(type(n) is int and 0 < n < 2**31 for n in size)
        _require(valid, f"{key} must be height and width in pixels, got {shown(size)}")
    # Earlier versions wrote none of these.
    complete, skipped = document.setdefault("complete", True), document.setdefault("skipped", [])
    noted, metric = document.setdefault("noted_focal_length", None), document.setdefault("metric", False)
    document["source"] = _source(document.get("source"))
    document["points"] = _point_filter(document.get("points", {}))
    _require(noted is None or bool(_numbers(noted, (), "noted_focal_length") > 0), "noted_focal_length must be above 0")
    timed, given = document.setdefault("timed", None), document.setdefault("world_is_given", False)
    for key, value in (
        ("complete", complete),
        ("metric", metric),
        ("timed", timed or False),
        ("world_is_given", given),
    ):
        _require(type(value) is bool, f"{key} must be true or false, got {shown(value)}")
    _require(
        isinstance(skipped, list)
        and all(isinstance(each, dict) and isinstance(each.get("name"), str) for each in skipped),
        f"skipped must be a list of frames with their names, got {shown(skipped)}",
    )
    frames = document.get("frames")
    _require(isinstance(frames, list) and bool(frames), f"frames must be a list of cameras, got {shown(frames)}")
    names: set[str] = set()
    for index, frame in enumerate(frames):
        _require(isinstance(frame, dict), f"frame {index} is no object but {shown(frame)}")
        name = frame.get("name")
        _require(_is_file_name(name), f"frame {index} has the name {shown(name)}, which cannot be that of a file")
        _require(name not in names, f"two frames have the name {name!r:.80}")
        names.add(name)
        where = f"of frame {index}, {name!r:.80},"
        frame["depth_scale"] = float(_numbers(frame.get("depth_scale", 1.0), (), f"the depth_scale {where}"))
        _require(frame["depth_scale"] > 0, f"the depth_scale {where} must be above 0")
        frame["masked"] = float(_numbers(frame.get("masked", 0.0), (), f"masked {where}"))
        _require(0 <= frame["masked"] <= 1, f"masked {where} must be a share, got {frame['masked']}")
        frame["timestamp"] = float(_numbers(frame.get("timestamp"), (), f"the timestamp {where}"))
        for key, shape in (("extrinsics", (3, 4)), ("intrinsics", (3, 3)), ("depth_intrinsics", (3, 3))):
            frame[key] = _numbers(frame.get(key), shape, f"the {key} {where}")
        _require(is_rotation(frame["extrinsics"][:, :3]), f"the extrinsics {where} hold no rotation")
        for key in ("intrinsics", "depth_intrinsics"):
            matrix = frame[key]
            pinhole = (matrix[2] == [0, 0, 1]).all() and matrix[1, 0] == 0 and (matrix.diagonal() != 0).all()
            _require(pinhole, f"the {key} {where} are not those of a pinhole camera")
    loops = document.setdefault("loops", None)
    _require(
        loops is None or (isinstance(loops, list) and all(_is_pair(pair, len(frames)) for pair in loops)),
        f"loops must be pairs of positions among the frames, got {shown(loops)}",
    )
    return document


def _source(value: Any) -> SourceRecord | None:
    kinds = {"path": str, "options": dict, "taken": int, "fingerprint": str}
    valid = isinstance(value, dict) and all(type(value.get(key)) is kind for key, kind in kinds.items())
    _require(value is None or valid, f"source must be null or say where frames came from, got {shown(value)}")
    return None if value is None else SourceRecord(**{key: value[key] for key in kinds})


def _point_filter(value: Any) -> PointFilter:
    try:
        return from_mapping(PointFilter, value, "points")
    except InputError as error:
        raise _Fault(str(error)) from error


def _require(condition: bool, complaint: str) -> None:
    if not condition:
        raise _Fault(complaint)


def _is_file_name(name: object) -> bool:
    return isinstance(name, str) and name not in ("", ".", "..") and "/" not in name and "\0" not in name


def _is_pair(value: object, below: int) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(type(n) is int and 0 <= n < below for n in value)


def _numbers(value: object, shape: tuple[int, ...], what: str) -> np.ndarray:
    """A JSON value as float64 numbers of a shape."""
    try:
        array = np.array(value)
    except ValueError:  # lists of unequal lengths
        array = np.array(None)
    # Whole numbers beyond 64 bits make an array of objects, as do null and text among numbers.
    valid = array.dtype.kind in "iuf" and array.shape == shape
    _require(valid, f"{what} must be {f'numbers {list(shape)}' if shape else 'a number'}, got {shown(value)}")
    array = array.astype(np.float64)
    largest = LARGEST_ENTRY if shape else np.inf  # of times there are some in nanoseconds
    _require(bool((np.abs(array) < largest).all()), f"{what} must be finite, and below {largest:g}")
    return array
