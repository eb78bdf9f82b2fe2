"""ARKitScenes (Baruch et al., NeurIPS Datasets and Benchmarks 2021): tablets' videos of rooms with depth.

Layout, as the set's download script makes it: `<root>/raw/{Training,Validation}/<video>/` with

- `vga_wide/<video>_<time>.png`, 30 Hz, and `vga_wide_intrinsics/<video>_<time>.pincam`: one line
  `width height fx fy cx cy`; its time may be 1 ms off the picture's;
- `lowres_depth/<video>_<time>.png`, 60 Hz: z in millimetres, 0 invalid, coarser than the picture by a fixed factor;
- `lowres_wide.traj`, about 10 Hz: lines `time ax ay az tx ty tz`, world-to-camera as an axis-angle vector and a
  translation in metres, OpenCV axes, the world's z up.

Also read is the part for 3D object detection, where the root has no raw form of a video: `<root>/3dod/{Training,
Validation}/<video>/<video>_frames/` with `lowres_wide`, `lowres_wide_intrinsics`, `lowres_depth` and `lowres_wide.traj`
likewise, pictures of 256 x 192.

Times are seconds with three decimals. The set does not say where a pixel's centre is; calibrations are taken as they
are. `confidence` tells how much the sensor trusts depth that it nevertheless gives: nothing is masked by it.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from logvggt_jax.data.dataset import TRAINING, About
from logvggt_jax.data.errors import UnequalSizes
from logvggt_jax.data.formats.calibration import in_pixels, numbers, pinhole, relative, whole_number
from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.data.formats.pose_track import PoseTrack
from logvggt_jax.data.formats.quarter_turns import turned_extrinsics, turned_intrinsics, turns_to_upright
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import INDOORS, NO_POSES, Dropped, FolderDataset, FrameRecord
from logvggt_jax.errors import InputError
from logvggt_jax.frames import same_proportions

_FOLDS = {"train": ("Training",), "val": ("Validation",), "all": ("Training", "Validation")}
_VIDEO = re.compile(r"\d+")
_MAX_TIME = 1e12  # seconds; milliseconds beyond it would leave int64
# Intrinsics of a record whose calibration is read with its picture.
_RAW, _DETECTION = "vga_wide", "lowres_wide"  # the folders of pictures in the two forms
_WITH_THE_PICTURE = np.full((3, 3), np.nan)


class ARKitScenes(FolderDataset):
    """Reader of ARKitScenes' videos; sequences are named `Training/41048190`, or `3dod/Training/41048190` in that form.

    Pictures are stored as the sensor delivers them, in many videos sideways. By default they are handed out upright:
    a sequence is turned as a whole, by the multiple of 90 degrees after which the cameras' mean upward direction is
    nearest to the world's, and depth, intrinsics and extrinsics are turned with it. `upright=False` keeps the stored
    orientation.

    Depth comes in the picture's pixels (nearest neighbour). A frame's pose is the trajectory's within 1 ms of the
    picture, otherwise interpolated between the neighbours in time: the camera's centre linearly, its rotation along
    the shortest arc. Pictures without depth (`no depth`), without a calibration within 1 ms (`no calibration`), or
    outside the trajectory's time (`no pose`) do not count. The splits follow the folders.
    """

    name = "arkitscenes"
    title = "ARKitScenes"
    expects = "raw/Training/<video>/vga_wide, or 3dod/Training/<video> (the folder that the download script was given)"
    metric = True
    plausible_depth = INDOORS
    splits = ("train", "val", "all")
    about = About(
        source="download script of the repository apple/ARKitScenes, raw data or 3dod",
        licence="Apple's own: personal, non-commercial; a second clause covers commercial use by companies with fewer "
        "than 700 million monthly users",
        size="5,071 videos (4,520 Training, 551 Validation); bytes of the raw form unknown (the 3DOD subset has "
        "623.4 GB)",
        roles=(TRAINING,),
    )

    def __init__(self, root: str | Path, split: str = "all", *, upright: bool = True) -> None:
        """As `FolderDataset`; `upright=False` hands pictures out in their stored orientation."""
        self.upright = upright
        super().__init__(root, split)

    @property
    def identity(self) -> dict[str, Any]:
        """As `FolderDataset`; the orientation turns frames."""
        return {**super().identity, "upright": self.upright}

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        places: dict[str, Path] = {}
        for fold in _FOLDS[self.split]:
            for video in self._videos(files, self.root / "raw" / fold):
                places[f"{fold}/{video.name}"] = video
            for video in self._videos(files, self.root / "3dod" / fold):
                if f"{fold}/{video.name}" not in places:
                    places[f"3dod/{fold}/{video.name}"] = video / f"{video.name}_frames"
        return places

    def _videos(self, files: SourceFiles, folder: Path) -> Iterable[Path]:
        return files.folders(folder, "videos", _VIDEO).values() if files.exists(folder) else ()

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        kind = _DETECTION if sequence.startswith("3dod/") else _RAW
        video = sequence.rpartition("/")[2]
        pictures = _by_time(files, folder / kind, video, "png")
        depths = _by_time(files, folder / "lowres_depth", video, "png")
        calibrations = _by_time(files, folder / f"{kind}_intrinsics", video, "pincam")
        path = folder / "lowres_wide.traj"
        track = _trajectory(files.text(path, "the video's poses; download it again"), path)
        cameras = {time: track.at(time) for time in sorted(pictures)}
        turns = 0
        if self.upright and (counted := [pose for pose in cameras.values() if pose is not None]):
            turns = turns_to_upright(np.stack(counted))
        for time, extrinsics in cameras.items():
            near = next((t for t in (time, time - 1, time + 1) if t in calibrations), None)
            if time not in depths:
                yield Dropped("no depth")
            elif near is None:
                yield Dropped("no calibration")
            elif extrinsics is None:
                yield Dropped("no pose")
            else:
                yield FrameRecord(
                    name=pictures[time].stem,
                    image=pictures[time],
                    depth=depths[time],
                    # Millions of one-line files: opened with their pictures, not to list them.
                    calibration=calibrations[near],
                    intrinsics=_WITH_THE_PICTURE,
                    extrinsics=turned_extrinsics(extrinsics, turns),
                    quarter_turns=turns,
                )

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        size = image.shape[:2]
        assert record.calibration is not None
        intrinsics = in_pixels(_calibration(record.calibration), size, record.image, record.calibration)
        intrinsics = turned_intrinsics(intrinsics, size, record.quarter_turns)
        return image, _at_size(read_depth(record.depth), size, record.depth), intrinsics


def _by_time(files: SourceFiles, folder: Path, video: str, suffix: str) -> dict[int, Path]:
    """Files of one of a video's folders by their time in milliseconds."""
    names = files.names(folder, f"the video's {folder.name}; download it again")
    form = re.compile(rf"{video}_(\d+\.\d+)\.{suffix}")
    return {_milliseconds(match[1]): folder / match[0] for match in filter(None, map(form.fullmatch, names))}


def _milliseconds(seconds: str | float) -> int:
    return round(1000 * float(seconds))


def _trajectory(text: str, path: Path) -> PoseTrack:
    times, poses = [], []
    for line, row in enumerate(text.splitlines(), start=1):
        if not row.strip():
            continue
        time, *vectors = numbers(row, f"{path}, line {line}", count=7)
        if not abs(time) < _MAX_TIME:  # NaN neither
            raise InputError(f"{path}, line {line}: expected a time in seconds first, got {time}: download it again")
        times.append(_milliseconds(time))
        poses.append(_pose(np.array(vectors)))
    if not times:
        raise InputError(f"{path}: no poses; download it again")
    return PoseTrack(np.array(times), np.stack(poses))


def _pose(vectors: np.ndarray) -> np.ndarray:
    """World-to-camera [4, 4] of an axis-angle vector and a translation [6]; NaN where that is lost."""
    if not np.isfinite(vectors).all():
        return NO_POSES
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(vectors[:3])[0], vectors[3:]
    return pose


def _calibration(path: Path) -> np.ndarray:
    """Intrinsics [3, 3] of a picture of one pixel."""
    text = SourceFiles().text(path, "the picture's calibration; download the video again")
    width, height, *values = numbers(text, path, count=6)
    size = whole_number(height, path), whole_number(width, path)
    if min(size) < 1:
        raise InputError(f"{path}: expected a width and height above 0, got {width:g} x {height:g}: download it again")
    return relative(pinhole(*values), size)


def _at_size(depth: np.ndarray, size: tuple[int, int], path: Path) -> np.ndarray:
    """Millimetres uint16 [h, w] as float32 metres in a picture of `size`, by the nearest neighbour."""
    if not same_proportions(depth.shape, size):
        raise UnequalSizes(
            f"{path}: depth of {depth.shape[1]} x {depth.shape[0]} does not have the shape of its picture of "
            f"{size[1]} x {size[0]}: download both again"
        )
    # In whole numbers: OpenCV's nearest neighbours shift by half a pixel or round ties, frequent at 2.5, unevenly.
    rows, columns = (
        (2 * np.arange(fine) + 1) * coarse // (2 * fine) for fine, coarse in zip(size, depth.shape, strict=True)
    )
    return depth[rows[:, None], columns].astype(np.float32) / np.float32(1000)
