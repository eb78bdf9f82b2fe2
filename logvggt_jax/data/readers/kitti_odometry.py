"""KITTI odometry (Geiger et al., CVPR 2012): eleven driving sequences with poses; depth only where it is added.

Layout, as unpacked from the archives of colour pictures, calibration and poses, whose common folder is `dataset`:

    <root>/sequences/00/image_2/000000.png
    <root>/sequences/00/calib.txt
    <root>/poses/00.txt

A line of the pose file is a frame's 3 x 4 matrix, rows first: from the rectified camera 0 (left, grey) at that frame to
camera 0 at the first, OpenCV axes, metres. `P2` in `calib.txt` is the 3 x 4 projection of points of camera 0 into the
left colour camera: its left 3 x 3 are the intrinsics K, and K^-1 times its last column is what a point's coordinates
in camera 2 have more than in camera 0.

The benchmark has no depth. Where one adds some, `sequences/00/depth_2/000000.png` in the form of KITTI's depth
benchmark (uint16, 256 a metre, 0 where nothing was measured), it is read.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, LICENCE_NOT_READ, About
from logvggt_jax.data.formats.calibration import world_to_camera
from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.data.formats.kitti_calibration import read_projection
from logvggt_jax.data.formats.numbered_files import numbered_files, numbered_frames, without_gaps
from logvggt_jax.data.formats.pose_lists import read_pose_list
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import Dropped, FolderDataset, FrameRecord, frame, read_depth_of
from logvggt_jax.errors import InputError
from logvggt_jax.geometry import compose

_WITH_POSES = re.compile(r"0\d|10")
_PICTURE = "{:06d}.png"
_MAX_SHIFT = 10.0  # metres between cameras on one car
_UNITS_PER_METRE = 256.0


class KITTIOdometry(FolderDataset):
    """Reader of KITTI odometry, left colour camera; sequences are named `00` to `10`.

    Without a folder `depth_2` the depth of a sequence's frames is 0 throughout, no pixel valid; with it, pictures
    without depth do not count. Poses are those of the colour camera. Sequences 11 to 21, whose poses are not published,
    are left out, so the splits are `train` and `all`, both of them the other eleven.
    """

    name = "kitti_odometry"
    title = "KITTI odometry"
    expects = "sequences/00 with image_2 and calib.txt, and poses/00.txt (the folder dataset of the archives)"
    metric = True
    splits = ("train", "all")
    about = About(
        source="the set's site: data_odometry_color.zip, data_odometry_calib.zip and data_odometry_poses.zip",
        licence=LICENCE_NOT_READ,
        size="11 sequences with poses (and 11 without); bytes unknown",
        roles=(EVALUATION,),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        return files.folders(self.root / "sequences", self.expects, _WITH_POSES)

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        calibration, pose_list = folder / "calib.txt", self.root / "poses" / f"{sequence}.txt"
        projection = read_projection(files, calibration, "P2", "the sequence's calibration: data_odometry_calib.zip")
        intrinsics, camera_2_from_0 = projection[:, :3], _from_camera_0(projection, calibration)
        images = [path for (path,) in without_gaps(numbered_frames(files, (folder / "image_2", _PICTURE)))]
        poses = read_pose_list(files, pose_list, count=len(images), numbers_per_line=12)
        depth_folder = folder / "depth_2"
        depths = numbered_files(files, depth_folder, _PICTURE) if files.exists(depth_folder) else None
        for line, (image, pose) in enumerate(zip(images, poses, strict=True), 1):
            depth = image if depths is None else depths.get(int(image.stem))
            if depth is None:
                yield Dropped("no depth")
                continue
            extrinsics = world_to_camera(pose, f"{pose_list}, line {line}", stored="camera_to_world")
            if extrinsics is not None:
                extrinsics = compose(camera_2_from_0, extrinsics)
            yield frame(image, depth, intrinsics, extrinsics, calibration=calibration)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        return image, read_depth_of(record, image, _UNITS_PER_METRE), record.intrinsics


def _from_camera_0(projection: np.ndarray, path: Path) -> np.ndarray:
    """[4, 4], from points of camera 0 to points of the camera of this `projection` [3, 4]."""
    try:
        shift = np.linalg.solve(projection[:, :3], projection[:, 3])
    except np.linalg.LinAlgError:
        shift = np.full(3, np.inf)
    if not np.abs(shift).max() <= _MAX_SHIFT:  # NaN neither
        raise InputError(
            f"{path}, P2: expected intrinsics, and a camera within {_MAX_SHIFT} m of camera 0: fetch the calibration "
            "again"
        )
    moved = np.eye(4)
    moved[:3, 3] = shift
    return moved
