"""Cameras, images and depth maps of COLMAP models, as its documentation of output formats and camera models has them.

A model is a folder with `cameras` and `images`, both as `.bin` (little-endian) or both as `.txt`. Parsed here: the
formats are small, and COLMAP's own library brings hundreds of megabytes.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from logvggt_jax.data.errors import BrokenPicture
from logvggt_jax.data.formats.calibration import numbers, pinhole, pose_from_quaternion, whole_number
from logvggt_jax.data.formats.lens import Lens
from logvggt_jax.data.formats.source_files import SourceFiles, read_regular
from logvggt_jax.errors import InputError

# By COLMAP's number: name and how many parameters.
_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)
_PARAMETERS = dict(_MODELS)
# Models whose parameters after focal lengths and principal point are OpenCV's, in its order: how many focal lengths,
# and whether it is a fisheye.
_OF_OPENCV = {
    "SIMPLE_PINHOLE": (1, False),
    "PINHOLE": (2, False),
    "SIMPLE_RADIAL": (1, False),
    "RADIAL": (1, False),
    "OPENCV": (2, False),
    "FULL_OPENCV": (2, False),
    "OPENCV_FISHEYE": (2, True),
    "SIMPLE_RADIAL_FISHEYE": (1, True),
    "RADIAL_FISHEYE": (1, True),
    "SIMPLE_FISHEYE": (1, True),
    "FISHEYE": (2, True),
}
_MAX_SIZE = 10**6  # pixels
_KEYPOINT_BYTES = 24
_DEPTH_HEADER = re.compile(rb"(\d{1,6})&(\d{1,6})&(\d{1,6})&")


@dataclass(frozen=True)
class ColmapCamera:
    """One of COLMAP's cameras.

    Attributes:
      model: its name.
      size: (H, W) of its pictures.
      parameters: as COLMAP stores them: focal length or lengths, principal point, distortion; pixels.
    """

    model: str
    size: tuple[int, int]
    parameters: tuple[float, ...]

    def pinhole_and_lens(self) -> tuple[np.ndarray, Lens] | None:
        """Intrinsics [3, 3] float64 in pixels with centres at integers, and the lens before them; None for models that
        are not among OpenCV's.

        The first pixel's centre is at (0.5, 0.5) for COLMAP, at (0, 0) here.
        """
        if self.model not in _OF_OPENCV:
            return None
        count, fisheye = _OF_OPENCV[self.model]
        focal, (cx, cy) = self.parameters[:count], self.parameters[count : count + 2]
        return pinhole(focal[0], focal[-1], cx - 0.5, cy - 0.5), Lens(self.parameters[count + 2 :], fisheye)


@dataclass(frozen=True)
class ColmapImage:
    """One of COLMAP's registered pictures.

    Attributes:
      name: its file, relative to the folder of pictures.
      camera: number of its camera.
      extrinsics: [4, 4] float64, world-to-camera, OpenCV axes; None where it is not finite.
    """

    name: str
    camera: int
    extrinsics: np.ndarray | None


class ChosenModel(NamedTuple):
    """The folder of a model, and what there is to say of why it is this one; None where there is no other."""

    folder: Path
    said: str | None


def choose_model(files: SourceFiles, folder: Path) -> ChosenModel:
    """Of the models in the folders of this one, as the mapper writes them, that with most registered pictures; the
    folder itself, as the undistorter writes it, where there are none.

    Raises MissingFiles where there is no such folder, InputError naming the file of a model that is not one.
    """
    models = _models(files, folder, "images") or _models(files, folder, "cameras")
    if len(models) < 2:
        return ChosenModel(models[0] if models else folder, None)
    counts = [_count_images(files, model) for model in models]
    largest = int(np.argmax(counts))
    others = ", ".join(f"{model.name}: {count}" for model, count in zip(models, counts, strict=True))
    return ChosenModel(
        models[largest],
        f"{folder} holds {len(models)} models, worlds of their own: of their pictures ({others}) those of "
        f"{models[largest].name}, the largest, have poses",
    )


def _models(files: SourceFiles, folder: Path, kind: str) -> list[Path]:
    return list(files.folders_with([f"{kind}.bin", f"{kind}.txt"], folder, "COLMAP's models").values())


def _count_images(files: SourceFiles, model: Path) -> int:
    path = _file_of(files, model, "images")
    if path.suffix == ".txt":
        return len(read_images(files, model)[1])
    # Before millions of keypoints.
    (count,) = _Binary(files.content(path, "the model's images"), path).take("Q")
    return int(count)


def read_cameras(files: SourceFiles, model: Path) -> tuple[Path, dict[int, ColmapCamera]]:
    """The cameras of the `model` in a folder by number, and the file that they are from.

    Raises MissingFiles, or InputError naming the file (and line, or camera).
    """
    path = _file_of(files, model, "cameras")
    if path.suffix == ".txt":
        return path, dict(_text_cameras(files.text(path, "the model's cameras"), path))
    return path, dict(_binary_cameras(_Binary(files.content(path, "the model's cameras"), path)))


def read_images(files: SourceFiles, model: Path) -> tuple[Path, list[ColmapImage]]:
    """The registered pictures of the `model` in a folder in its order, and the file that they are from.

    Raises MissingFiles, or InputError naming the file (and line, or picture).
    """
    path = _file_of(files, model, "images")
    if path.suffix == ".txt":
        return path, list(_text_images(files.text(path, "the model's images"), path))
    return path, list(_binary_images(_Binary(files.content(path, "the model's images"), path)))


def read_depth_map(path: Path) -> np.ndarray:
    """z-depth [H, W] float32 of a file in `stereo/depth_maps`, in the model's unit, as stored.

    Raises MissingFiles, or InputError naming the file.
    """
    content = read_regular(path)
    header = _DEPTH_HEADER.match(content)
    if header is None or int(header[3]) != 1:
        raise BrokenPicture(f"{path}: expected a depth map ('width&height&1&'), got {content[:16]!r}: compute it again")
    width, height = int(header[1]), int(header[2])
    expected, found = 4 * width * height, len(content) - header.end()
    if found != expected or not expected:
        raise BrokenPicture(
            f"{path}: a depth map of {width} x {height} has {expected} bytes after its header, got {found}: compute it "
            "again"
        )
    return np.frombuffer(content, "<f4", offset=header.end()).astype(np.float32).reshape(height, width)


def _file_of(files: SourceFiles, model: Path, kind: str) -> Path:
    """COLMAP prefers the binary file where both are there."""
    binary, text = model / f"{kind}.bin", model / f"{kind}.txt"
    return text if files.exists(text) and not files.exists(binary) else binary


def _camera(model: str, size: tuple[int, int], parameters: tuple[float, ...], where: str) -> ColmapCamera:
    if not (min(size) >= 1 and max(size) <= _MAX_SIZE and np.isfinite(parameters).all()):
        raise InputError(
            f"{where}: expected a width and height from 1 to {_MAX_SIZE} and finite parameters, got {size[1]} x "
            f"{size[0]} and {', '.join(f'{value:g}' for value in parameters)}: export the model again"
        )
    return ColmapCamera(model, size, parameters)


def _image(name: str, camera: int, pose: np.ndarray, where: str) -> ColmapImage:
    """`pose`: quaternion (w first) and translation [7]."""
    extrinsics = pose_from_quaternion(pose[[1, 2, 3, 0]], pose[4:], where, stored="world_to_camera")
    return ColmapImage(name, camera, extrinsics)


def _text_cameras(text: str, path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for line, content in enumerate(text.splitlines(), 1):
        if not content.strip() or content.startswith("#"):
            continue
        where, words = f"{path}, line {line}", content.split()
        model = words[1] if len(words) > 1 else ""
        if len(words) != 4 + _PARAMETERS.get(model, -4):
            raise InputError(
                f"{where}: expected a camera's number, one of COLMAP's models, width, height and its parameters, got "
                f"{content[:60]!r}: export the model again"
            )
        number, width, height, *parameters = numbers(" ".join([words[0], *words[2:]]), where).tolist()
        size = whole_number(height, where), whole_number(width, where)
        yield whole_number(number, where), _camera(model, size, tuple(parameters), where)


def _text_images(text: str, path: Path) -> Iterator[ColmapImage]:
    lines = iter([(i, line) for i, line in enumerate(text.splitlines(), 1) if not line.startswith("#")])
    for number, line in lines:
        if not line.strip():
            continue
        where, words = f"{path}, line {number}", line.split(maxsplit=9)
        if len(words) != 10:
            raise InputError(
                f"{where}: expected a picture's number, qw qx qy qz tx ty tz, its camera and its name, got "
                f"{line[:60]!r}: export the model again"
            )
        values = numbers(" ".join(words[:9]), where, count=9)
        yield _image(words[9].strip(), whole_number(values[8], where), values[1:8], where)
        number, keypoints = next(lines, (number, ""))
        # The number of the last one's point. Files that others write may lack the line, and every second picture's
        # would then be taken for it.
        last = keypoints.rsplit(maxsplit=1)[-1:]
        if last and not last[0].lstrip("-").isdecimal():
            raise InputError(
                f"{path}, line {number}: expected the keypoints of the picture in the line above it, or an empty line "
                f"where it has none, got {keypoints[:60]!r}: write the line that is missing"
            )


def _binary_cameras(binary: "_Binary") -> Iterator[tuple[int, ColmapCamera]]:
    (count,) = binary.take("Q")
    for _ in range(count):
        number, model, width, height = binary.take("IiQQ")
        where = f"{binary.path}, camera {number}"
        if not 0 <= model < len(_MODELS):
            raise InputError(f"{where}: COLMAP has no model {model}, as of 4.2: export the model again")
        name, parameters = _MODELS[model]
        yield number, _camera(name, (height, width), binary.take(f"{parameters}d"), where)
    binary.check_end()


def _binary_images(binary: "_Binary") -> Iterator[ColmapImage]:
    (count,) = binary.take("Q")
    for _ in range(count):
        number, *pose, camera = binary.take("I7dI")
        name = binary.text()
        yield _image(name, camera, np.array(pose), f"{binary.path}, image {number} {name!r}")
        (keypoints,) = binary.take("Q")
        binary.skip(keypoints * _KEYPOINT_BYTES)
    binary.check_end()


class _Binary:
    """Values of a binary file, taken one after the other; InputError naming it where it ends too early or too late."""

    def __init__(self, content: bytes, path: Path) -> None:
        self.path = path
        self._content, self._position = content, 0

    def take(self, kinds: str) -> tuple[Any, ...]:
        """Values of these kinds, as in `struct`, little-endian and without gaps."""
        form = struct.Struct(f"<{kinds}")
        start = self._position
        self.skip(form.size)
        return form.unpack_from(self._content, start)

    def text(self) -> str:
        """Text up to a zero byte."""
        end = self._content.find(b"\0", self._position)
        start, self._position = self._position, end + 1
        try:
            if end < 0:
                raise self._damaged()
            return self._content[start:end].decode()
        except UnicodeDecodeError as error:
            raise self._damaged() from error

    def skip(self, count: int) -> None:
        self._position += count
        if self._position > len(self._content):
            raise self._damaged()

    def check_end(self) -> None:
        if self._position != len(self._content):
            raise self._damaged()

    def _damaged(self) -> InputError:
        return InputError(
            f"{self.path}: truncated or damaged COLMAP model of {len(self._content)} bytes: export it again"
        )
