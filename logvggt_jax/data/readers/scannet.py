"""ScanNet v2 (Dai et al., CVPR 2017): RGB-D video of indoor scenes.

Layout, as exported by the SensReader of the official repository: `<root>/<part>/<scene>/` with
`color/<n>.jpg`, `depth/<n>.png`, `pose/<n>.txt` and `intrinsic/intrinsic_depth.txt`. `<part>` is `scans_train`,
`scans_test`, `scannetv2` or, as the set's download script names the scenes of training and validation, `scans`; or it
is left out. Scenes are named `scene0000_00`. Numbers are not padded (`0.jpg`), or are, as other exporters write them
(`000000.jpg`). Depth is uint16 in millimetres, 0 where invalid. Poses are camera-to-world in metres, OpenCV axes; a
lost frame's entries are `-inf`. Intrinsics are 4x4.

Also read, where a scene has no `color`, is the form that published evaluations prepare (MonST3R's script):
`color_90/frame_0000.jpg`, `depth_90/frame_0000.png` and `pose_90.txt` with 16 numbers a line, and likewise for other
numbers than 90. These are frames already chosen, every third from the first.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np

from logvggt_jax.data.dataset import EVALUATION, TRAINING, About
from logvggt_jax.data.errors import AbsurdIntrinsics, MissingFiles, UnequalSizes
from logvggt_jax.data.formats.calibration import numbers, world_to_camera
from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.data.formats.numbered_files import numbered_frames, without_gaps
from logvggt_jax.data.formats.pose_lists import read_pose_list
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import INDOORS, Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.errors import InputError
from logvggt_jax.frames import same_proportions

_SCENE = re.compile(r"scene\d{4}_\d{2}")
_PREPARED = re.compile(r"color_(\d+)")
# The download script's folder, whose scenes may have been exported to another.
_DOWNLOADED = "scans"
_PARTS = {_DOWNLOADED: None, "scans_train": "train", "scans_test": "test", "scannetv2": None}


class ScanNet(FolderDataset):
    """Reader of ScanNet v2; sequences are named `scene0000_00`, in the prepared form `scene0000_00/color_90`.

    Frames are handed out at the depth camera's size with its intrinsics, colour resized to it by area: ScanNet
    registers depth to colour, so that the two differ by size alone. Frames whose pose is not finite are dropped;
    scenes whose intrinsics are not finite are left out.

    Splits follow the official list files `scannetv2_{train,val,test}.txt` where one of them lies in `root`. Without
    them `train` is what lies in `scans_train`, `test` what lies in `scans_test`, and there is no `val`.
    """

    name = "scannet"
    title = "ScanNet"
    expects = (
        "scans, scans_train, scans_test or scannetv2 with scene0000_00/{color,depth,pose,intrinsic} (export the .sens)"
    )
    metric = True
    plausible_depth = INDOORS
    splits = ("train", "val", "test", "all")
    about = About(
        source="terms-of-use form by e-mail (repository ScanNet/ScanNet); export each .sens with its SensReader; for "
        "splits the lists scannetv2_{train,val,test}.txt in the root",
        licence="ScanNet's terms of use, which the form states",
        size="1,613 scenes in the lists (1,201 train, 312 val, 100 test); bytes unknown",
        roles=(TRAINING, EVALUATION),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        places: dict[str, Path] = {}
        left_out: list[Path] = []
        for scene, folder in sorted(self._chosen_scenes(files).items()):
            if not _is_calibrated(folder, files):
                left_out.append(folder)
                files.remark(f"{folder} is left out: its intrinsics are not finite")
                continue
            names = files.names(folder, "color, depth, pose and intrinsic")
            prepared = [name for name in names if _PREPARED.fullmatch(name)]
            if "color" in names or not prepared:
                places[scene] = folder
            else:
                places |= {f"{scene}/{name}": folder / name for name in prepared}
        if left_out and not places:
            raise AbsurdIntrinsics(
                f"{_calibration(left_out[0])}: intrinsics are not finite, nor are those of any other of "
                f"{len(left_out)} scenes: export them again"
            )
        return places

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        if match := _PREPARED.fullmatch(folder.name):
            scene, count = folder.parent, match[1]
            kinds = ((folder, "frame_{:04d}.jpg"), (scene / f"depth_{count}", "frame_{:04d}.png"))
            paths = without_gaps(numbered_frames(files, *kinds))
            pose_list = scene / f"pose_{count}.txt"
            poses = read_pose_list(files, pose_list, count=len(paths))
            frames = [(image, depth, pose, pose_list) for (image, depth), pose in zip(paths, poses, strict=True)]
        else:
            scene = folder
            export = numbered_frames(
                files, (folder / "color", "{}.jpg"), (folder / "depth", "{}.png"), (folder / "pose", "{}.txt")
            )
            frames = [(image, depth, _pose(path, files), path) for image, depth, path in export.values()]
        path = _calibration(scene)
        intrinsics = numbers(files.text(path, "the depth camera's intrinsics"), path, count=16).reshape(4, 4)[:3, :3]
        for image, depth, pose, where in frames:
            extrinsics = world_to_camera(pose, where, stored="camera_to_world")
            yield frame(image, depth, intrinsics, extrinsics, calibration=path)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image, raw = read_rgb(record.image), read_depth(record.depth)
        (height, width), (image_height, image_width) = raw.shape, image.shape[:2]
        if not same_proportions(raw.shape, image.shape):  # 1296 x 968 and 640 x 480 differ by 0.4 %
            raise UnequalSizes(
                f"{record.depth}: {width} x {height} has another aspect ratio than {image_width} x {image_height} of "
                f"{record.image}: export both again"
            )
        if image.shape[:2] != raw.shape:
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        return image, raw.astype(np.float32) / np.float32(1000.0), record.intrinsics

    def _chosen_scenes(self, files: SourceFiles) -> dict[str, Path]:
        parts: dict[str, str | None] = {"": None, **_PARTS}
        lists = {split: self.root / f"scannetv2_{split}.txt" for split in ("train", "val", "test")}
        listed = [files.exists(path) for path in lists.values()]
        scenes: dict[str, Path] = {}
        for part, part_split in parts.items():
            other = self.split != "all" and not any(listed) and part_split != self.split
            if other or not files.exists(self.root / part):
                continue
            for name, folder in files.folders(self.root / part, "scenes", _SCENE).items():
                if part == _DOWNLOADED and not _is_exported(folder, files):
                    continue
                if name in scenes:
                    raise InputError(f"{folder} and {scenes[name]} are the same scene: remove one of them")
                scenes[name] = folder
        if self.split == "all":
            return scenes
        path = lists[self.split]
        if not any(listed):
            if self.split == "val":
                raise MissingFiles(f"{path}: no such file; add the official list or choose another split")
            return scenes
        names = files.text(path, "the official list file; add it or choose split='all'").split()
        for name in names:
            if name not in scenes:
                raise MissingFiles(
                    f"{self.root}: no folder of scene {name}, but {path.name} lists it; export it or edit the list"
                )
        return {name: scenes[name] for name in names}


def _is_exported(scene: Path, files: SourceFiles) -> bool:
    """Whether a scene's folder has pictures, and not only the files that the set's owners publish of it."""
    return any(name == "color" or _PREPARED.fullmatch(name) for name in files.names(scene, "color, depth and pose"))


def _calibration(scene: Path) -> Path:
    return scene / "intrinsic" / "intrinsic_depth.txt"


def _is_calibrated(scene: Path, files: SourceFiles) -> bool:
    """Whether the intrinsics are finite; a scene without the file passes, so that listing it names the file."""
    path = _calibration(scene)
    return not files.exists(path) or bool(np.isfinite(numbers(files.text(path, "intrinsics"), path)).all())


def _pose(path: Path, files: SourceFiles) -> np.ndarray:
    return numbers(files.text(path, "the frame's pose"), path, count=16).reshape(4, 4)
