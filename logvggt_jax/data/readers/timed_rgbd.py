"""What TUM RGB-D and the data sets in its format share: three streams with clocks of their own, associated by time.

`rgb.txt` and `depth.txt` hold lines `time file`, `groundtruth.txt` lines `time tx ty tz qx qy qz qw`, camera-to-world,
metres and seconds; `#` starts a comment.
"""

import abc
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from logvggt_jax.data.errors import MissingFiles, UnequalCounts, missing_files
from logvggt_jax.data.formats.calibration import in_pixels, numbers, pose_from_quaternion, relative
from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import (
    INDOORS,
    NO_POSES,
    Dropped,
    FolderDataset,
    FrameRecord,
    frame,
    read_depth_of,
)
from logvggt_jax.errors import InputError

TOLERANCE = 0.02  # seconds
_SIZE = (480, 640)  # that the calibrations belong to
UNITS_PER_METRE = 5000.0
_MAX_TIME = 1e12  # seconds; much larger ones have no milliseconds in float64
_PREPARED = re.compile(r"rgb_(\d+)")
_TIMED_FILE = re.compile(r"(\d+(?:\.\d+)?)\.(?:png|jpg|jpeg)", re.IGNORECASE)


def associate(first: np.ndarray, second: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
    """For each time of `first` [n] the index of its partner in `second` [m], or -1; int [n].

    Partners are less than `tolerance` apart. The closest two of all become partners first, then the closest of the
    rest, as in TUM's own tool: no entry has two partners. Both arrays are in ascending order.
    """
    starts = np.searchsorted(second, first - tolerance, side="left")
    ends = np.searchsorted(second, first + tolerance, side="right")
    rows = np.repeat(np.arange(len(first)), ends - starts)
    columns = np.concatenate([np.arange(s, e) for s, e in zip(starts, ends, strict=True)] or [np.empty(0)]).astype(int)
    gaps = np.abs(first[rows] - second[columns])
    partners, taken = np.full(len(first), -1), np.zeros(len(second), bool)
    for pair in np.argsort(gaps, kind="stable"):
        row, column = rows[pair], columns[pair]
        if gaps[pair] < tolerance and partners[row] < 0 and not taken[column]:
            partners[row], taken[column] = column, True
    return partners


class TimedRGBD(FolderDataset):
    """Reader of data sets in TUM's format, `rgb`, `depth`, `rgb.txt`, `depth.txt` and `groundtruth.txt` a sequence.

    Depth and pose of a picture are those nearest in time, less than 0.02 s away. Pictures without depth or without
    a pose that near are dropped. Intrinsics are for 640 x 480 and scale with the image. Depth is uint16, 5000 a metre,
    0 where invalid. Sequences are named as their folders.

    Where a sequence has neither `rgb` nor `rgb.txt`, the form that published evaluations prepare (MonST3R's scripts) is
    read: `rgb_90`, `depth_90` and `groundtruth_90.txt`, and likewise for other numbers; the sequence is then named
    `<folder>/rgb_90`. Files are named by their time; picture i belongs to depth i, since those scripts pair by place.
    Poses are associated by time.
    """

    metric = True
    plausible_depth = INDOORS
    splits = ("all",)
    folder_pattern: ClassVar[re.Pattern[str]]
    container: ClassVar[str | None]  # folder below `root` that may hold the sequences
    prepared_for: ClassVar[str]  # `depth`: poses may be missing from the prepared form; `poses`: depth may be

    @abc.abstractmethod
    def _intrinsics(self, folder: Path) -> np.ndarray:
        """Intrinsics [3, 3] at 640 x 480 of the camera that recorded the sequence in `folder`."""

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        parents = [self.root, *([self.root / self.container] if self.container else [])]
        folders: dict[str, Path] = {}
        for parent in filter(files.exists, parents):
            for name, folder in files.folders(parent, "sequences", self.folder_pattern).items():
                if name in folders:
                    raise InputError(f"{folder} and {folders[name]} are the same sequence: remove one of them")
                folders[name] = folder
        places: dict[str, Path] = {}
        for name, folder in sorted(folders.items()):
            held = files.names(folder, "rgb, depth, rgb.txt, depth.txt and groundtruth.txt")
            if "rgb" in held or "rgb.txt" in held:
                places[name] = folder
            else:
                places |= {f"{name}/{part}": folder / part for part in held if _PREPARED.fullmatch(part)}
        return places

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        if match := _PREPARED.fullmatch(folder.name):
            yield from self._prepared_frames(folder.parent, match[1], files)
            return
        times, images = listed_files(folder / "rgb.txt", files)
        depth_times, depths = listed_files(folder / "depth.txt", files)
        trajectory = Trajectory(folder / "groundtruth.txt", files)
        depth_of, pose_of = associate(times, depth_times), associate(times, trajectory.times)
        for image, depth_index, pose_index in zip(images, depth_of, pose_of, strict=True):
            if depth_index < 0:
                yield Dropped("no depth")
            else:
                extrinsics = trajectory.extrinsics(pose_index) if pose_index >= 0 else None
                yield frame(image, depths[depth_index], self._intrinsics(folder), extrinsics)

    def _prepared_frames(self, folder: Path, count: str, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        times, images = named_files(folder / f"rgb_{count}", files)
        depth_folder = folder / f"depth_{count}"
        if self.prepared_for == "poses" and not files.exists(depth_folder):
            depths = images  # a picture in depth's place stands for no depth
        else:
            _, depths = named_files(depth_folder, files)
        if len(depths) != len(images):
            raise UnequalCounts(
                f"{depth_folder}: expected {len(images)} files, as in {folder}/rgb_{count}, got {len(depths)}: "
                "prepare both again"
            )
        trajectory = Trajectory(folder / f"groundtruth_{count}.txt", files)
        pose_of = associate(times, trajectory.times)
        if (pose_of < 0).any() and self.prepared_for == "poses":
            raise InputError(
                f"{trajectory.path}: expected a pose within {TOLERANCE} s of each picture, got none for "
                f"{images[int(np.argmin(pose_of))].name}: prepare both again"
            )
        for image, depth, pose_index in zip(images, depths, pose_of, strict=True):
            extrinsics = NO_POSES if (pose_of < 0).any() else trajectory.extrinsics(pose_index)
            yield frame(image, depth, self._intrinsics(folder), extrinsics)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        intrinsics = in_pixels(relative(record.intrinsics, _SIZE), image.shape[:2], record.image)
        return image, read_depth_of(record, image, UNITS_PER_METRE), intrinsics


class Trajectory:
    """Poses in TUM's format, in order of time."""

    def __init__(self, path: Path, files: SourceFiles) -> None:
        lines, rows = [], []
        for line, text in content_lines(files.text(path, "the trajectory, lines 'time tx ty tz qx qy qz qw'")):
            lines.append(line)
            rows.append(numbers(text, f"{path}, line {line}", count=8))
            _check_time(rows[-1][0], f"{path}, line {line}")
        if not rows:
            raise InputError(f"{path}: expected lines 'time tx ty tz qx qy qz qw', got none: fetch the file again")
        values = np.array(rows)
        order = np.argsort(values[:, 0], kind="stable")
        self.path = path
        self._lines, self._poses = np.array(lines)[order], values[order, 1:]
        self.times = values[order, 0]

    def extrinsics(self, index: int) -> np.ndarray | None:
        """World-to-camera [4, 4] of pose `index`; None where it is not finite. BadPose for no unit quaternion."""
        position, quaternion = self._poses[index, :3], self._poses[index, 3:]
        where = f"{self.path}, line {self._lines[index]}"
        return pose_from_quaternion(quaternion, position, where, stored="camera_to_world")


def listed_files(path: Path, files: SourceFiles) -> tuple[np.ndarray, list[Path]]:
    """Times [n] and files of a list `time file`, in order of time; every file is there."""
    entries: dict[Path, float] = {}
    for line, text in content_lines(files.text(path, "lines 'time file'")):
        words = text.split(maxsplit=1)  # names may have spaces
        if len(words) != 2:
            raise InputError(f"{path}, line {line}: expected 'time file', got {text!r}: fetch the file again")
        file = path.parent / words[1].replace("\\", "/")
        if file in entries:
            raise InputError(f"{path}, line {line}: {words[1]} is listed twice: fetch the file again")
        (time,) = numbers(words[0], f"{path}, line {line}", count=1)
        _check_time(time, f"{path}, line {line}")
        entries[file] = float(time)
    if not entries:
        raise InputError(f"{path}: expected lines 'time file', got none: fetch the file again")
    present = {
        folder: set(files.names(folder, f"the files that {path.name} lists"))
        for folder in {file.parent for file in entries}
    }
    absent = [file for file in entries if file.name not in present[file.parent]]
    if absent:
        raise missing_files(dict.fromkeys(absent, f"but {path.name} lists it; fetch it or edit the list"))
    ordered = sorted(entries, key=lambda file: entries[file])
    return np.array([entries[file] for file in ordered]), ordered


def named_files(folder: Path, files: SourceFiles) -> tuple[np.ndarray, list[Path]]:
    """Times [n] and files of a folder whose files are named by their time, in order of time."""
    matches = map(_TIMED_FILE.fullmatch, files.names(folder, "pictures named by their time, 1305031102.1753.png"))
    entries = sorted((float(match[1]), folder / match[0]) for match in matches if match)
    if not entries:
        raise MissingFiles(f"{folder}: no pictures named by their time, as 1305031102.1753.png; prepare it again")
    return np.array([time for time, _ in entries]), [file for _, file in entries]


def _check_time(time: float, where: str) -> None:
    if not abs(time) < _MAX_TIME:  # NaN neither
        raise InputError(f"{where}: expected a time in seconds first, got {time:g}: fetch the file again")


def content_lines(text: str) -> Iterator[tuple[int, str]]:
    """Number and content of the lines that hold something besides a comment."""
    for line, content in enumerate(text.splitlines(), 1):
        if content := content.split("#")[0].strip():
            yield line, content
