"""What a teacher says of a clip, and where it is kept.

    <cache>/teacher/<digest>/   of one clip: depth.npy, confidence.npy, intrinsics.npy, extrinsics.npy, and digests.json
                                of these four, since numpy does not notice flipped bytes
    <cache>/teacher.lock        held together by all that write labels, see `cache_in_use`

The digest is of the clip's pictures, as the teacher saw them, and of the teacher: what has been labelled once is never
labelled again, by whatever run, and never taken for something else.
"""

import hashlib
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from absl import logging

from logvggt_jax.errors import InputError, OutputExists, disk_errors
from logvggt_jax.files import atomic_folder, numpy_reading, read_json
from logvggt_jax.weights.digests import digests, verify_digests

DIGEST_BYTES = 16
_DIGESTS = "digests.json"
_MEND = "the clip is labelled again"


class Labels(NamedTuple):
    """What a teacher says of a clip, float32, in the frame of its first camera and in a unit of its own.

    Attributes:
      depth: [T, H, W] z-depth.
      confidence: [T, H, W], at least 1.
      intrinsics: [T, 3, 3], pixels.
      extrinsics: [T, 4, 4], world-to-camera (OpenCV).
    """

    depth: np.ndarray
    confidence: np.ndarray
    intrinsics: np.ndarray
    extrinsics: np.ndarray


def label_digest(images: np.ndarray, teacher: str) -> bytes:
    """Of a clip's images [T, H, W, 3] uint8 and of the teacher that has this digest."""
    found = hashlib.sha256(f"1 {teacher} {images.shape}".encode())
    found.update(np.ascontiguousarray(images).data)
    return found.digest()[:DIGEST_BYTES]


def label_folder(cache: Path, digest: bytes) -> Path:
    """Where the labels of this digest are kept."""
    return cache / "teacher" / digest.hex()


def write_labels(folder: Path, labels: Labels) -> None:
    """Keeps them in `folder`, in the place of damaged ones; DiskError where they cannot be written."""
    try:
        with disk_errors(folder), atomic_folder(folder, replace=folder.exists()) as fresh:
            for name, values in labels._asdict().items():
                np.save(fresh / f"{name}.npy", values)
            (fresh / _DIGESTS).write_text(json.dumps(digests(labels._asdict())))
    except OutputExists:  # another run labelled the same clip in the meantime
        return


def stored_labels(folder: Path) -> Labels:
    """What `folder` keeps, read from the disk where they are used; InputError naming what is missing or damaged."""
    arrays = []
    for name in Labels._fields:
        path = folder / f"{name}.npy"
        try:
            with numpy_reading():
                arrays.append(np.load(path, mmap_mode="r", allow_pickle=False))
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read ({error}): start the run again, which labels the clip") from error
    return Labels(*arrays)


def is_labelled(folder: Path, shape: tuple[int, ...]) -> bool:
    """Whether `folder` keeps labels of images of this shape, (T, H, W, 3), as they were written; a warning names those
    that have changed since."""
    try:
        labels = stored_labels(folder)
    except InputError:
        return False
    frames = shape[0]
    expected = (shape[:3], shape[:3], (frames, 3, 3), (frames, 4, 4))
    return tuple(values.shape for values in labels) == expected and _are_whole(folder, labels)


def _are_whole(folder: Path, labels: Labels) -> bool:
    written = folder / _DIGESTS
    if not written.exists():  # labels of before there were digests pass as they are
        return True
    try:
        expected = read_json(written, _MEND)
        if not isinstance(expected, dict):
            raise InputError(f"{written}: no digests; {_MEND}")
        verify_digests(labels._asdict(), expected, str(folder), mend=_MEND)
    except InputError as error:
        logging.warning("%s", error)
        return False
    return True
