"""WildRGB-D (Xia et al., CVPR 2024): phone videos with depth around objects of 46 categories.

Layout, as in the set's zip files: `<root>/<category>/scenes/scene_NNN/{rgb,depth,masks}/NNNNN.png`, beside them
`metadata` (JSON with the picture's width `w` and height `h` and the nine intrinsics `K`, column by column) and
`cam_poses.txt` (a line a frame: its number and 16 numbers, camera-to-world row by row, OpenCV axes, metres); per
category the lists `nvs_list.json` and `camera_eval_list.json`. (The set's README writes `scenes_<id>`; its files have
`scene_<id>`.) Depth is z in millimetres, 0 invalid. `masks` show the object and are not needed.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import TRAINING, About
from logvggt_jax.data.errors import missing_files
from logvggt_jax.data.formats.calibration import in_pixels, numbers, relative, whole_number, world_to_camera
from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.data.formats.json_values import expecting, read_json
from logvggt_jax.data.formats.numbered_files import numbered_frames
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.formats.split_lists import sequences_present
from logvggt_jax.data.readers.folder_dataset import INDOORS, Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.errors import InputError

_SCENE = re.compile(r"scene_\d+")
_LISTED = re.compile(r"scenes/scene_\d+")
_LIST_FILES = ("nvs_list.json", "camera_eval_list.json")
# Left out by published training code.
_EXCLUDED = {"box/scene_257"}


class WildRGBD(FolderDataset):
    """Reader of WildRGB-D; sequences are named `apple/scene_000`.

    The split `train` holds the scenes that both lists of their category train on, `test` all others. Listed scenes
    that are not in the root are left out, since the set comes in parts; `box/scene_257` is in no split, as in
    published training code. Frames without a line in `cam_poses.txt` do not count. Pictures and depth may be resized
    copies: the intrinsics follow their size.
    """

    name = "wildrgbd"
    title = "WildRGB-D"
    expects = "<category>/scenes/scene_NNN/rgb (unpack the categories' zip files)"
    metric = True
    plausible_depth = INDOORS
    splits = ("train", "test", "all")
    about = About(
        source="zip files by category (repository wildrgbd/wildrgbd)",
        licence="unknown: not stated in the repository",
        size="3.37 TB of zip files, about 4 TB unpacked; 46 categories",
        roles=(TRAINING,),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        places: dict[str, Path] = {}
        for category in files.names(self.root, self.expects):
            scenes = self.root / category / "scenes"
            if not files.exists(scenes):
                continue
            present = {f"{category}/{name}" for name in files.folders(scenes, "scenes", _SCENE)} - _EXCLUDED
            if self.split != "all":
                training = _training_scenes(self.root / category, files)
                if self.split == "train":
                    present &= set(sequences_present(training - _EXCLUDED, present, self.root / category, files))
                else:
                    present -= training
            places |= {name: scenes / name.partition("/")[2] for name in sorted(present, key=_number)}
        return places

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        intrinsics = _intrinsics(files, folder / "metadata")
        poses = _poses(files, folder / "cam_poses.txt")
        paths = numbered_frames(files, (folder / "rgb", "{:05d}.png"), (folder / "depth", "{:05d}.png"))
        absent = [folder / "rgb" / f"{number:05d}.png" for number in poses if number not in paths]
        if absent:
            raise missing_files(dict.fromkeys(absent, "but the frame has a pose; fetch it or remove that"))
        for number, (image, depth) in paths.items():
            yield frame(image, depth, intrinsics, poses.get(number), calibration=folder / "metadata")

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        depth = read_depth(record.depth).astype(np.float32) / np.float32(1000)
        return image, depth, in_pixels(record.intrinsics, image.shape[:2], record.image, record.calibration)


def _number(scene: str) -> tuple[str, int]:
    """Sorts scenes of one category by their number."""
    category, _, number = scene.rpartition("_")
    return category, int(number)


def _training_scenes(category: Path, files: SourceFiles) -> set[str]:
    """Names (`apple/scene_000`) that both of a category's lists have under `train`."""
    listed = []
    for name in _LIST_FILES:
        path = category / name
        content = _json(files.text(path, "the category's list file; fetch it or choose split='all'"), path)
        train = content.get("train")
        if not isinstance(train, list) or not all(isinstance(s, str) and _LISTED.fullmatch(s) for s in train):
            raise InputError(f"{path}: expected names like 'scenes/scene_000' under 'train': restore the original file")
        listed.append({f"{category.name}/{scene.partition('/')[2]}" for scene in train})
    return set.intersection(*listed)


def _intrinsics(files: SourceFiles, path: Path) -> np.ndarray:
    """Intrinsics [3, 3] of a picture of one pixel."""
    content = _json(files.text(path, "the scene's calibration; unpack its zip file again"), path)
    with expecting(path, "w, h and the nine numbers K"):
        width, height = int(content["w"]), int(content["h"])
        # Column by column.
        matrix = np.array(content["K"], np.float64).reshape(3, 3).T
    if not (width > 0 and height > 0):
        raise InputError(f"{path}: expected a width and height above 0, got {width} x {height}: fetch it again")
    return relative(matrix, (height, width))


def _json(text: str, path: Path) -> dict:
    content = read_json(text, path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a JSON object, got {type(content).__name__}: fetch it again")
    return content


def _poses(files: SourceFiles, path: Path) -> dict[int, np.ndarray | None]:
    """World-to-camera matrices by frame number, None where a pose is not finite."""
    text = files.text(path, "the scene's poses; unpack its zip file again")
    poses: dict[int, np.ndarray | None] = {}
    for line, row in enumerate(text.splitlines(), start=1):
        if not row.strip():
            continue
        where = f"{path}, line {line}"
        values = numbers(row, where, count=17)
        number = whole_number(values[0], f"{where}: frame number")
        poses[number] = world_to_camera(values[1:].reshape(4, 4), where, stored="camera_to_world")
    if not poses:
        raise InputError(f"{path}: no poses; fetch it again")
    return poses
