"""Recordings of one's own in the form of TUM RGB-D, with a calibration file.

Layout: the root is a recording, or holds folders that are recordings. A recording holds

- `rgb.txt`, lines `time file` with files relative to the recording, or without it `rgb/<time>.png` (or `.jpg`);
- `depth.txt` and `depth/<time>.png` likewise, or neither for recordings without depth;
- `groundtruth.txt`, lines `time tx ty tz qx qy qz qw`, camera-to-world, metres, OpenCV axes;
- `calibration.txt`, which may also lie in the root for all recordings in it: lines `name value`,

      width 640          of the pictures that the next four belong to, pixels
      height 480
      fx 525.0           focal lengths and principal point, pixels; the centre of the first pixel is at (0, 0)
      fy 525.0
      cx 319.5
      cy 239.5
      depth_scale 1000   units of the 16-bit depth in a metre; left out: 5000, as in TUM RGB-D
      k1 -0.05           distortion k1, k2, p1, p2, k3 as OpenCV has it; left out: 0

Times are seconds; `#` starts a comment. Depth lies in the pictures' pixels.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, TRAINING, About
from logvggt_jax.data.errors import AbsurdIntrinsics
from logvggt_jax.data.formats.calibration import in_pixels, numbers, pinhole, relative, whole_number
from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.data.formats.lens import Lens
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import Dropped, FolderDataset, FrameRecord, frame, read_depth_of
from logvggt_jax.data.readers.own_recordings import find_recordings, without_distortion
from logvggt_jax.data.readers.timed_rgbd import (
    TOLERANCE,
    UNITS_PER_METRE,
    Trajectory,
    associate,
    content_lines,
    listed_files,
    named_files,
)
from logvggt_jax.errors import InputError

_CALIBRATION = "calibration.txt"
_NEEDED = ("width", "height", "fx", "fy", "cx", "cy")
_DEPTH_SCALE = "depth_scale"
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_MAX = 1e6  # pixels, and units of depth a metre


class TUMRecording(FolderDataset):
    """Reader of recordings in TUM's form; sequences are named as their folders.

    Depth and pose of a picture are those nearest in time, less than 0.02 s away; pictures without depth or without a
    pose that near are dropped. Without any depth the frames' depth is 0 throughout, no pixel valid. Pictures may be
    resized copies: the intrinsics follow their size.

    Lens distortion is taken out while a frame is read: picture and depth are those of a pinhole of the same size, focal
    lengths and principal point, where nothing was seen black with depth 0.
    """

    name = "tum_recording"
    title = "own recordings in TUM's form"
    expects = (
        f"rgb, depth, groundtruth.txt and {_CALIBRATION} (lines 'fx 525.0', also fy cx cy width height depth_scale), "
        "or folders that do"
    )
    metric = True
    splits = ("all",)
    own = True
    about = About(
        source="record it: rgb and depth with files named by their time, or rgb.txt and depth.txt that list them",
        licence="your own",
        size="your own",
        roles=(TRAINING, EVALUATION),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        return find_recordings(
            self.root, files, self.expects, lambda each: files.exists(each / "rgb") or files.exists(each / "rgb.txt")
        )

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        own = folder / _CALIBRATION
        calibration = own if files.exists(own) or folder == self.root else self.root / _CALIBRATION
        intrinsics, lens, units = _camera(files, calibration)
        times, images = _stream(folder, "rgb", files)
        trajectory = Trajectory(folder / "groundtruth.txt", files)
        pose_of = _partners(times, trajectory.times, "poses", trajectory.path)
        if files.exists(folder / "depth.txt") or files.exists(folder / "depth"):
            depth_times, depths = _stream(folder, "depth", files)
            depth_of = _partners(times, depth_times, "depth", folder / "depth")
        else:
            depths, depth_of = images, np.arange(len(images))  # a picture in depth's place stands for no depth
        for image, depth_index, pose_index in zip(images, depth_of, pose_of, strict=True):
            if depth_index < 0:
                yield Dropped("no depth")
                continue
            extrinsics = trajectory.extrinsics(pose_index) if pose_index >= 0 else None
            others = {"depth_scale": 1 / units, "calibration": calibration, "lens": lens.row}
            yield frame(image, depths[depth_index], intrinsics, extrinsics, **others)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        intrinsics = in_pixels(record.intrinsics, image.shape[:2], record.image, record.calibration)
        depth = read_depth_of(record, image, 1 / record.depth_scale)
        # A few pixels tell a unit that is wrong by powers of ten.
        few = depth[::8, ::8]
        middle = float(np.median(few[few > 0])) if few.any() else 1.0
        low, high = self.plausible_depth
        if not low <= middle <= high:
            raise InputError(
                f"{record.depth}: half of the depth is beyond {middle:.3g} m, with depth_scale="
                f"{1 / record.depth_scale:g} in {record.calibration}: give the units of the files in a metre there "
                "(`logvggt data check tum_recording` tells more)"
            )
        return without_distortion(record, image, depth, intrinsics)


def _stream(folder: Path, kind: str, files: SourceFiles) -> tuple[np.ndarray, list[Path]]:
    """Times [n] and files of a recording's pictures or depth, in order of time."""
    listing = folder / f"{kind}.txt"
    return listed_files(listing, files) if files.exists(listing) else named_files(folder / kind, files)


def _partners(times: np.ndarray, others: np.ndarray, kind: str, path: Path) -> np.ndarray:
    """As `associate`; InputError where no picture has a partner, naming both recorders' times."""
    found = associate(times, others)
    if (found < 0).all():
        raise InputError(
            f"{path}: no {kind} within {TOLERANCE} s of any picture: {kind} from {others[0]:.2f} to "
            f"{others[-1]:.2f} s, pictures from {times[0]:.2f} to {times[-1]:.2f} s: give both one clock's times"
        )
    return found


def _camera(files: SourceFiles, path: Path) -> tuple[np.ndarray, Lens, float]:
    """Intrinsics [3, 3] of a picture of one pixel, the lens, and units of depth a metre."""
    known = (*_NEEDED, _DEPTH_SCALE, *_DISTORTION)
    values: dict[str, float] = {}
    for line, text in content_lines(files.text(path, f"the calibration, lines 'name value' of {', '.join(known)}")):
        name, value = [*text.split(maxsplit=1), ""][:2]
        if name not in known or name in values:
            raise InputError(
                f"{path}, line {line}: expected each of {', '.join(known)} once, got {name!r}: edit the file"
            )
        (values[name],) = numbers(value, f"{path}, line {line}", count=1)
    absent = [name for name in _NEEDED if name not in values]
    if absent:
        raise InputError(f"{path}: no line {', '.join(absent)}: add what is missing")
    size = whole_number(values["height"], path), whole_number(values["width"], path)
    units = values.get(_DEPTH_SCALE, UNITS_PER_METRE)
    if not (min(size) >= 1 and max(size) <= _MAX and 1 <= units <= _MAX):
        raise InputError(f"{path}: width, height and depth_scale must be from 1 to {_MAX:g}: edit the file")
    intrinsics = pinhole(*(values[name] for name in ("fx", "fy", "cx", "cy")))
    lens = Lens(tuple(values.get(name, 0.0) for name in _DISTORTION))
    if not (np.isfinite(intrinsics).all() and np.isfinite(lens.coefficients).all()):
        raise AbsurdIntrinsics(f"{path}: intrinsics must be finite, distortion too: edit the file")
    return relative(intrinsics, size), lens, units
