"""All numbers of a sequence's cameras on disk, as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.files import write_text

CAMERAS_FILE = "cameras.json"
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
    """
    frames: list[dict[str, Any]] = [
        {
            "name": name,
            "timestamp": float(timestamp),
            "extrinsics": extrinsics[i].tolist(),
            "intrinsics": intrinsics[i].tolist(),
            "depth_intrinsics": model_intrinsics[i].tolist(),
        }
        for i, (name, timestamp) in enumerate(zip(names, timestamps, strict=True))
    ]
    document = {
        "format": CAMERAS_FORMAT,
        "conventions": "extrinsics [3, 4] are world-to-camera, OpenCV axes (x right, y down, z forward); the world "
        "is the first camera's frame as the model estimates it, lengths are up to one common scale; intrinsics are "
        "in pixels of the original images, depth_intrinsics in pixels of the depth maps; pixel centres lie at "
        "integers",
        "image_size": list(image_size),
        "depth_size": list(model_size),
        "complete": complete,
        "skipped": [{"name": name, "reason": reason} for name, reason in skipped],
        "frames": frames,
    }
    write_text(path, json.dumps(document, indent=1) + "\n")


def is_complete(path: Path) -> bool:
    """Whether a cameras file is there that does not say that its run was ended early."""
    try:
        return json.loads(path.read_text()).get("complete", True) is True
    except (OSError, ValueError, AttributeError):
        return False


def read_cameras(path: str | Path) -> dict[str, Any]:
    """Inverse of `write_cameras`: the document, with the frames' matrices as float64 arrays.

    Raises:
      FileNotFoundError: no such file.
      ValueError: not a file that `write_cameras` has written.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingInput(f"{path} does not exist: expected the output of `logvggt reconstruct`")
    try:
        with disk_errors(path):
            document = json.loads(path.read_text())
        known = document["format"] == CAMERAS_FORMAT
        for frame in document["frames"]:
            for key in ("extrinsics", "intrinsics", "depth_intrinsics"):
                frame[key] = np.array(frame[key], np.float64)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is not a cameras file of this program: {error!r}") from None
    if not known:
        raise InputError(f"{path} has format {document['format']!r}, expected {CAMERAS_FORMAT!r}")
    return document
