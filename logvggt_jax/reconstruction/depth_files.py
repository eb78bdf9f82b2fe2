"""Depth maps and images on disk, one file a frame."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from PIL import Image

from logvggt_jax.errors import InputError, MissingInput, one_line
from logvggt_jax.files import atomic_file, numpy_reading, open_regular
from logvggt_jax.reconstruction.cameras_file import CAMERAS_FILE

DEPTH_FOLDER, IMAGE_FOLDER, ORIGINAL_FOLDER = "depth", "images", "originals"
_END_OF_JPEG = b"\xff\xd9"
_JPEG = (
    *(cv2.IMWRITE_JPEG_QUALITY, 95),
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
)


def depth_file(folder: Path, name: str) -> Path:
    """Where a result folder keeps the depth of the frame of this name."""
    return folder / DEPTH_FOLDER / f"{name}.npz"


def image_file(folder: Path, name: str) -> Path:
    """Where a result folder keeps the image of the frame of this name."""
    return folder / IMAGE_FOLDER / f"{name}.jpg"


def original_file(folder: Path, name: str) -> Path:
    """Where a result folder keeps the picture of the frame of this name at its own size, if it does."""
    return folder / ORIGINAL_FOLDER / f"{name}.jpg"


def write_depth(path: str | Path, depth: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Writes an .npz file with `depth` and `confidence`, [H, W] float16.

    That is 11 bits (0.05 % of the depth, finer than the estimate); values beyond its range become 65504. Depth is
    z-depth in the unit of the trajectory, confidence is at least 1; both are 0 where a mask has dropped the pixel.

    Returns:
      Depth and confidence as `read_depth` will give them back.
    """
    depth, confidence = _half(depth), _half(confidence)
    with atomic_file(path) as temporary:
        np.savez(temporary, depth=depth, confidence=confidence)
    return depth.astype(np.float32), confidence.astype(np.float32)


def check_range(depth: np.ndarray, what: str) -> None:
    """Raises InputError, naming `what`, where more than a hundredth of a depth map is lost to the numbers of a file."""
    valid = depth[np.isfinite(depth) & (depth > 0)]
    limits = np.finfo(np.float16)
    lost = np.count_nonzero((valid > float(limits.max)) | (valid < float(limits.tiny)))
    if lost > 0.01 * valid.size:
        raise InputError(
            f"{what}: its depth would be {np.median(valid):.3g} (median), and files of depth hold {limits.tiny:.1g} to "
            f"{limits.max:g}: give lengths in another unit, such as metres"
        )


def read_depth(path: str | Path, size: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Depth and confidence, [H, W] float32, of a file that `write_depth` has written.

    Pixels to which the model gave no number hold none here either.

    Args:
      path: the .npz file.
      size: (H, W) that the maps must have; None for any.

    Raises:
      MissingInput: no such file.
      InputError: another file, damaged, or of another size.
    """
    with _result_file(path) as stream:
        try:
            with numpy_reading(), np.load(stream, allow_pickle=False) as arrays:
                # What has no array's header comes as bytes.
                maps = np.asarray(arrays["depth"]), np.asarray(arrays["confidence"])
        except ValueError as error:
            raise InputError(f"{path}: no depth file of this program, or damaged: {error}") from error
    for name, values in zip(("depth", "confidence"), maps, strict=True):
        if values.dtype.kind != "f" or values.ndim != 2 or (size is not None and values.shape != size):
            expected = "[H, W]" if size is None else f"{list(size)}, as {CAMERAS_FILE} says"
            found = f"{list(values.shape)} of {values.dtype}"
            raise InputError(f"{path}: {name} must be floats {expected}, got {found}; reconstruct again")
    return maps[0].astype(np.float32), maps[1].astype(np.float32)


def is_whole(path: Path) -> bool:
    """Whether a file that `write_depth` or `write_picture` (as JPEG) has written is there, and to its end; of depth the
    checksums that it holds are compared."""
    try:
        with open_regular(path) as stream:
            if path.suffix == ".npz":
                with zipfile.ZipFile(stream) as archive:
                    return archive.testzip() is None
            stream.seek(-len(_END_OF_JPEG), os.SEEK_END)
            return stream.read() == _END_OF_JPEG
    except Exception:  # zipfile meets damaged files with a dozen kinds
        return False


def write_picture(path: str | Path, image: np.ndarray) -> None:
    """Writes an RGB image [H, W, 3] uint8, or numbers [H, W] uint16, as PNG or JPEG, whichever the suffix says.

    JPEG has a quality that keeps nearly every pixel to a few grey levels.
    """
    content = encode_picture(Path(path).suffix, image)
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)


def encode_picture(suffix: str, image: np.ndarray) -> bytes:
    """The content of a file with this suffix, see `write_picture`."""
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(suffix, pixels, _JPEG if suffix == ".jpg" else ())
    return encoded.tobytes()


def read_picture(path: str | Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """An image that `write_picture` has written as JPEG, [H, W, 3] uint8 RGB.

    Args:
      path: the file.
      size: (H, W) that it must have; None for any.

    Raises:
      MissingInput: no such file.
      InputError: it is no picture, damaged, or of another size.
    """
    with _result_file(path) as stream:
        try:
            with Image.open(stream, formats=("JPEG",)) as picture:
                height, width = picture.height, picture.width
                if size is None or size == (height, width):
                    return np.asarray(picture.convert("RGB"))
        except Exception as error:  # Pillow meets damaged pictures with as many kinds as it has decoders
            raise InputError(f"{path}: cannot be read as a picture ({one_line(error)}); reconstruct again") from error
    raise InputError(
        f"{path} has {height} x {width} pixels, expected {size[0]} x {size[1]}, as {CAMERAS_FILE} says; "
        "reconstruct again"
    )


@contextmanager
def _result_file(path: str | Path) -> Iterator[BinaryIO]:
    try:
        with open_regular(path) as stream:
            yield stream
    except MissingInput:
        raise MissingInput(f"{path} does not exist: expected the output of `logvggt reconstruct`") from None


def _half(values: np.ndarray) -> np.ndarray:
    limit = float(np.finfo(np.float16).max)
    return np.clip(values, -limit, limit).astype(np.float16)
