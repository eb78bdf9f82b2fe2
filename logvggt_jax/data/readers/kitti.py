"""KITTI depth (Uhrig et al., 3DV 2017): driving video with accumulated, sparse LiDAR depth; no poses.

Layout, as unpacked from `data_depth_annotated.zip`, the raw recordings (synced and rectified) and their calibration:

    <root>/{train,val}/<drive>/proj_depth/groundtruth/image_02/0000000005.png
    <root>/<date>/<drive>/image_02/data/0000000005.png
    <root>/<date>/calib_cam_to_cam.txt

with drives `2011_09_26_drive_0002_sync` of date `2011_09_26`. Depth is uint16, 256 a metre, 0 where nothing was
measured; the first and last pictures of a drive have none. Intrinsics are the left 3x3 of `P_rect_02`.

Also read, for drives without raw pictures, is the form that published evaluations prepare (MonST3R's script):
`<root>/depth_selection/val_selection_cropped/{image_gathered,groundtruth_depth_gathered}/<drive>_02/*.png`, or
`image_gathered_50` and likewise; it needs the calibration too.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, LICENCE_NOT_READ, About
from logvggt_jax.data.errors import missing_files
from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.data.formats.kitti_calibration import read_projection
from logvggt_jax.data.formats.numbered_files import numbered_files, numbered_frames
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import NO_POSES, Dropped, FolderDataset, FrameRecord, frame

_DRIVE = re.compile(r"\d{4}_\d{2}_\d{2}_drive_\d{4}_\w+")
_GATHERED = re.compile(r"image_gathered(_\d+)?")
_PICTURE = "{:010d}.png"
_UNITS_PER_METRE = 256.0


class KITTI(FolderDataset):
    """Reader of KITTI depth, left colour camera; sequences are named `2011_09_26_drive_0002_sync`.

    The benchmark has no poses: extrinsics are NaN. Pictures without depth are dropped. Gathered sequences belong to
    `val` and are named `2011_09_26_drive_0002_sync/image_gathered`.
    """

    name = "kitti"
    title = "KITTI depth"
    expects = "train or val of the annotated depth, and raw recordings as <date>/<drive>/image_02/data"
    metric = True
    splits = ("train", "val", "all")
    about = About(
        source="the set's site: data_depth_annotated.zip, and the raw recordings (synced and rectified) of its drives "
        "with the calibration of their dates",
        licence=LICENCE_NOT_READ,
        size="13 drives in val; bytes unknown",
        roles=(EVALUATION,),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        places: dict[str, Path] = {}
        gathered = self._gathered(files) if self.split != "train" else {}
        for part in ("train", "val") if self.split == "all" else (self.split,):
            if not files.exists(self.root / part):
                continue
            for name in files.names(self.root / part, "drives"):
                is_gathered = any(sequence.startswith(f"{name}/") for sequence in gathered)
                if _DRIVE.fullmatch(name) and (files.exists(self._raw_pictures(name)) or not is_gathered):
                    places[name] = self.root / part / name
        places |= {name: place for name, place in gathered.items() if name.split("/")[0] not in places}
        return dict(sorted(places.items()))

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        drive = sequence.split("/")[0]
        calibration = self.root / _date(drive) / "calib_cam_to_cam.txt"
        expected = f"the date's calibration; unpack {_date(drive)}_calib.zip"
        intrinsics = read_projection(files, calibration, "P_rect_02", expected)[:, :3]
        if sequence == drive:
            image_folder = self._raw_pictures(drive)
            depths = numbered_files(files, folder / "proj_depth" / "groundtruth" / "image_02", _PICTURE)
            images = numbered_files(files, image_folder, _PICTURE)
            absent = {
                image_folder / _PICTURE.format(number): f"but {depth} exists; unpack the raw recording again"
                for number, depth in depths.items()
                if number not in images
            }
            if absent:
                raise missing_files(absent)
        else:
            depth_folder = folder.parent.with_name(_depth_folder(folder.parent.name)) / folder.name
            pairs = numbered_frames(files, (folder, _PICTURE), (depth_folder, _PICTURE))
            images, depths = ({number: pair[kind] for number, pair in pairs.items()} for kind in (0, 1))
        for number, image in images.items():
            if number in depths:
                yield frame(image, depths[number], intrinsics, NO_POSES, calibration=calibration)
            else:
                yield Dropped("no depth")

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        depth = read_depth(record.depth).astype(np.float32) / np.float32(_UNITS_PER_METRE)
        return read_rgb(record.image), depth, record.intrinsics

    def _raw_pictures(self, drive: str) -> Path:
        return self.root / _date(drive) / drive / "image_02" / "data"

    def _gathered(self, files: SourceFiles) -> dict[str, Path]:
        parent = self.root / "depth_selection" / "val_selection_cropped"
        if not files.exists(parent):
            return {}
        return {
            f"{drive.removesuffix('_02')}/{kind}": parent / kind / drive
            for kind in files.names(parent, "gathered pictures and depth")
            if _GATHERED.fullmatch(kind)
            for drive in files.names(parent / kind, "drives")
            if _DRIVE.fullmatch(drive) and drive.endswith("_02")
        }


def _date(drive: str) -> str:
    return drive.split("_drive_")[0]


def _depth_folder(image_folder: str) -> str:
    return image_folder.replace("image_gathered", "groundtruth_depth_gathered")
