"""7-Scenes (Glocker et al., ISMAR 2013; Shotton et al., CVPR 2013): Kinect sequences of seven rooms.

Layout: `<root>/<scene>/seq-NN/frame-NNNNNN.{color.png|color.jpg, depth.png, pose.txt}`, optionally
`frame-NNNNNN.depth.proj.png`, and per scene `TrainSplit.txt` and `TestSplit.txt` with lines `sequence1`. Poses are
camera-to-world in metres, OpenCV axes, of the depth camera. Colour and raw depth come from two cameras that the
set does not register: depth has focal length 585, colour 525, and lies 25 mm to the side.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, LICENCE_NOT_READ, About, check_indices
from logvggt_jax.data.errors import MissingFiles, missing_files
from logvggt_jax.data.formats.calibration import in_pixels, numbers, pinhole, relative, scaled, world_to_camera
from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import INDOORS, NO_POSES, Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.data.readers.sfm_poses import read_sfm_poses
from logvggt_jax.errors import InputError
from logvggt_jax.geometry import compose, unproject

COLOUR_FROM_DEPTH = np.array([-0.025, 0.0, 0.0])  # metres, identity rotation
_COLOUR_FOCAL, _DEPTH_FOCAL = 525.0, 585.0  # pixels at 640 x 480
_CENTRE, _SIZE = (320.0, 240.0), (480, 640)
_MAX_DEPTH = 10000  # millimetres, valid itself
_SEQUENCE = re.compile(r"seq-\d{2}")
_FRAME_FILE = re.compile(r"(frame-\d{6})\.(color\.png|color\.jpg|depth\.proj\.png|depth\.png|pose\.txt)")
# Rendered rooms have the set's names, and cameras of their own.
_OTHER_CAMERA = "intrinsics.txt"
_LIST_LINE = re.compile(r"[^\d]*(\d+)[^\d]*")
_LIST_FILES = {"train": "TrainSplit.txt", "test": "TestSplit.txt"}


class SevenScenes(FolderDataset):
    """Reader of 7-Scenes; sequences are named `redkitchen/seq-01`; `root` may be one scene's folder.

    Depth is handed out in the colour camera's pixels with its intrinsics (focal length 525 at 640 x 480, scaled
    with the image). Where `depth.proj.png` exists it is taken as it is, with the poses as stored, as published
    evaluations do. Otherwise raw depth is carried over: invalid pixels (0 and 65535) are masked, points shifted
    by `COLOUR_FROM_DEPTH`, projected into the colour camera, the nearest kept for each pixel, and the extrinsics
    composed with the same shift. Depth beyond 10 m or under 1 mm becomes 0. Rotations, rounded in the files, are
    projected onto SO(3). The splits `train` and `test` follow the scenes' list files.
    """

    name = "seven_scenes"
    title = "7-Scenes"
    expects = "<scene>/seq-NN or seq-NN with frame-NNNNNN.color.png (unpack the sequences' zip files)"
    metric = True
    plausible_depth = INDOORS
    splits = ("train", "test", "all")
    about = About(
        source="the set's site: a zip file a scene, zip files of sequences within",
        licence=LICENCE_NOT_READ,
        size="7 scenes; bytes unknown",
        roles=(EVALUATION,),
    )

    def sfm_extrinsics(self, sequence: str, indices: Sequence[int]) -> np.ndarray | None:
        """Structure-from-motion poses [T, 4, 4] float32 of frames, world-to-camera of the colour camera.

        Read from files `pgt_sfm*.txt` in the scene's folder, see `sfm_poses`. None where they do not have the sequence;
        NaN for single frames that they lack. `extrinsics` of `read` are those of the data set itself, which drift by
        about 1.5 degrees.
        """
        names = self.frame_names(sequence)
        folder = self._places[sequence]
        poses: dict[str, np.ndarray] = {}
        for path in sorted(folder.parent.glob("pgt_sfm*.txt")):
            poses |= read_sfm_poses(path)
        found = [poses.get(f"{folder.name}/{names[i]}", NO_POSES) for i in check_indices(indices, len(names), sequence)]
        return np.stack(found).astype(np.float32) if np.isfinite(found).any() else None

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        folders: dict[str, Path] = {}
        for scene in _scenes(self.root, files):
            listed = (
                _sequence_folders(scene, files) if self.split == "all" else _listed_folders(scene, self.split, files)
            )
            # A root such as "." has no name of its own.
            folders |= {f"{scene.resolve().name}/{folder.name}": folder for folder in listed}
        return folders

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        kinds: dict[str, set[str]] = {}
        names = files.names(folder, "a sequence's frames")
        if _OTHER_CAMERA in names:
            files.remark(
                f"{folder}: holds {_OTHER_CAMERA}, as what `logvggt render-room` writes; it is not read: frames have "
                f"the camera of {self.title}. Rendered rooms are the data set `rooms`"
            )
        for name in names:
            if match := _FRAME_FILE.fullmatch(name):
                kinds.setdefault(match[1], set()).add(match[2])
        if not kinds:
            raise MissingFiles(f"{folder}: no files like frame-000000.color.png; unpack the sequence's zip file")
        absent = {
            folder / f"{name}.{choices[-1]}": f"but frame {name} has {', '.join(sorted(present))}; fetch it or remove "
            "the frame"
            for name, present in sorted(kinds.items())
            for choices in (("color.jpg", "color.png"), ("depth.proj.png", "depth.png"), ("pose.txt",))
            if not present & set(choices)
        }
        if absent:
            raise missing_files(absent)
        for name, present in sorted(kinds.items()):
            path = folder / f"{name}.pose.txt"
            values = numbers(files.text(path, "the frame's pose"), path, count=16)
            pose = world_to_camera(values.reshape(4, 4), path, stored="camera_to_world")
            colour = "color.png" if "color.png" in present else "color.jpg"
            depth = "depth.proj.png" if "depth.proj.png" in present else "depth.png"
            if pose is not None and depth == "depth.png":
                pose = _shifted(pose)
            intrinsics = pinhole(_COLOUR_FOCAL, _COLOUR_FOCAL, *_CENTRE)
            yield frame(folder / f"{name}.{colour}", folder / f"{name}.{depth}", intrinsics, pose, name=name)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image, depth = read_rgb(record.image), _metres(read_depth(record.depth))
        matrix = in_pixels(relative(record.intrinsics, _SIZE), image.shape[:2], record.image)
        if not record.depth.name.endswith(".proj.png"):
            depth = _carry_to_colour(depth, matrix, image.shape[:2])
        return image, depth, matrix


def _scenes(root: Path, files: SourceFiles) -> list[Path]:
    own = _sequence_folders(root, files)
    scenes = [folder for folder in files.folders(root, "scenes").values() if _sequence_folders(folder, files)]
    if own and scenes:
        raise InputError(
            f"{root} holds sequences ({own[0].name}) and scenes ({scenes[0].name}) side by side: "
            "pass the folder that holds only scenes, or one scene's folder"
        )
    return [root] if own else scenes


def _sequence_folders(scene: Path, files: SourceFiles) -> list[Path]:
    return list(files.folders(scene, "sequences", _SEQUENCE).values())


def _listed_folders(scene: Path, split: str, files: SourceFiles) -> list[Path]:
    path = scene / _LIST_FILES[split]
    text = files.text(path, "the scene's list file; add it or choose split='all'")
    folders = []
    for line in filter(None, map(str.strip, text.splitlines())):
        match = _LIST_LINE.fullmatch(line)
        if match is None:
            raise InputError(f"{path}: expected lines like 'sequence1', got {line!r}: restore the original file")
        folder = scene / f"seq-{int(match[1]):02d}"
        if not folder.is_dir():
            raise MissingFiles(f"{folder}: no such folder, but {path.name} lists it; unpack it or edit the list")
        folders.append(folder)
    return sorted(set(folders))


def _at_size(intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics for 640 x 480 as those of a picture of `size` (H, W)."""
    return scaled(intrinsics, size[1] / _SIZE[1], size[0] / _SIZE[0])


def _metres(raw: np.ndarray) -> np.ndarray:
    """Millimetres uint16 as float32 metres, 0 where invalid (0 and 65535 in the files) or out of range."""
    # Before anything is carried; compared as integers, which is several times faster. 65535 is out of range as well.
    return np.where(raw <= _MAX_DEPTH, raw, np.uint16(0)).astype(np.float32) / np.float32(1000.0)


def _shifted(extrinsics: np.ndarray) -> np.ndarray:
    shift = np.eye(4)
    shift[:3, 3] = COLOUR_FROM_DEPTH
    return compose(shift, extrinsics)


def _carry_to_colour(depth: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Depth camera's map [h, w] as the colour camera (`intrinsics`, `size`) sees it; 0 where no point falls."""
    own = _at_size(pinhole(_DEPTH_FOCAL, _DEPTH_FOCAL, *_CENTRE), depth.shape)
    points = unproject(depth.astype(np.float64), own)[depth > 0] + COLOUR_FROM_DEPTH
    z = points[:, 2]
    u = np.rint(points[:, 0] / z * intrinsics[0, 0] + intrinsics[0, 2]).astype(np.intp)
    v = np.rint(points[:, 1] / z * intrinsics[1, 1] + intrinsics[1, 2]).astype(np.intp)
    inside = (u >= 0) & (u < size[1]) & (v >= 0) & (v < size[0])
    nearest = np.full(size, np.inf, np.float32)
    np.minimum.at(nearest.reshape(-1), (v * size[1] + u)[inside], z[inside].astype(np.float32))
    return np.where(np.isfinite(nearest), nearest, np.float32(0.0))
