"""7-Scenes (Glocker et al., ISMAR 2013; Shotton et al., CVPR 2013): Kinect sequences of seven rooms.

Layout: `<root>/<scene>/seq-XX/frame-XXXXXX.{color.png|color.jpg, depth.png, pose.txt}`, optionally
`frame-XXXXXX.depth.proj.png`, and per scene `TrainSplit.txt` and `TestSplit.txt` with lines `sequence1`. Poses are
camera-to-world in metres, OpenCV axes, of the depth camera. Colour and raw depth come from two cameras that the
set does not register: depth has focal length 585, colour 525, and lies 25 mm to the side.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from logvggt_jax.data.dataset import check_indices, check_sequence, check_split
from logvggt_jax.data.image_files import read_depth, read_rgb
from logvggt_jax.geometry import compose, invert, nearest_rotation, unproject
from logvggt_jax.types import Frames

COLOUR_FROM_DEPTH = np.array([-0.025, 0.0, 0.0])  # metres, identity rotation
_COLOUR_FOCAL, _DEPTH_FOCAL = 525.0, 585.0  # pixels at 640 x 480
_CENTRE, _SIZE = (320.0, 240.0), (480, 640)
_MIN_DEPTH, _MAX_DEPTH = 0.001, 10.0  # metres, both valid themselves
_SEQUENCE = re.compile(r"seq-\d{2}")
_FRAME_FILE = re.compile(r"(frame-\d{6})\.(color\.png|color\.jpg|depth\.proj\.png|depth\.png|pose\.txt)")
_LIST_LINE = re.compile(r"[^\d]*(\d+)[^\d]*")
_LIST_FILES = {"train": "TrainSplit.txt", "test": "TestSplit.txt"}


class _Frame(NamedTuple):
    name: str
    colour: Path
    depth: Path
    extrinsics: np.ndarray  # [4, 4] float64, world-to-camera of the camera that `depth` belongs to


class SevenScenes:
    """Reader of 7-Scenes; sequences are named `redkitchen/seq-01`.

    Depth is handed out in the colour camera's pixels with its intrinsics (focal length 525 at 640 x 480, scaled
    with the image). Where `depth.proj.png` exists it is taken as it is, with the poses as stored, as published
    evaluations do. Otherwise raw depth is carried over: invalid pixels (0 and 65535) are masked, points shifted
    by `COLOUR_FROM_DEPTH`, projected into the colour camera, the nearest kept for each pixel, and the extrinsics
    composed with the same shift. Depth beyond 10 m or under 1 mm becomes 0. Rotations, rounded in the files, are
    projected onto SO(3).
    """

    def __init__(self, root: str | Path, split: str = "all") -> None:
        """Lists the sequences; frames are listed when a sequence is first used.

        Args:
          root: the folder of the scenes, or one scene's folder.
          split: `train` or `test` by the scenes' list files, or `all`, which needs none. There is no `val`.

        Raises:
          FileNotFoundError: no such folder, no sequences in it, a list file or a listed sequence is missing.
          ValueError: unknown split, a list line without a number, or both scenes and sequences in `root`.
        """
        check_split(split)
        if split == "val":
            raise ValueError("7-Scenes has no validation split: choose train, test or all")
        self.root = Path(root)
        self._folders: dict[str, Path] = {}
        for scene in _scenes(self.root):
            folders = _sequence_folders(scene) if split == "all" else _listed_folders(scene, split)
            # A root such as "." has no name of its own.
            self._folders |= {f"{scene.resolve().name}/{folder.name}": folder for folder in folders}
        self.sequences: tuple[str, ...] = tuple(self._folders)
        self._frames: dict[str, list[_Frame]] = {}

    def num_frames(self, sequence: str) -> int:
        """Frames with image, depth and a finite pose."""
        return len(self._listed(sequence))

    def frame_names(self, sequence: str) -> list[str]:
        """`frame-000000` and so on, as the files are named."""
        return [frame.name for frame in self._listed(sequence)]

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        """Frames `indices`, metric.

        Raises ValueError for truncated or damaged pictures, wrong types, or sizes that do not belong together.
        """
        frames = self._listed(sequence)
        chosen = [frames[i] for i in check_indices(indices, len(frames), f"7-Scenes, {sequence}")]
        images: list[np.ndarray] = []
        depths: list[np.ndarray] = []
        intrinsics: list[np.ndarray] = []
        extrinsics: list[np.ndarray] = []
        for frame in chosen:
            image = read_rgb(frame.colour)
            if images and image.shape != images[0].shape:
                raise ValueError(
                    f"{frame.colour}: size {image.shape[:2]} differs from {images[0].shape[:2]} of "
                    f"{chosen[0].colour.name}: frames of one sequence must have one size"
                )
            matrix = _intrinsics(_COLOUR_FOCAL, image.shape[:2])
            depth, pose = _metres(read_depth(frame.depth)), frame.extrinsics
            if frame.depth.name.endswith(".proj.png"):
                if depth.shape != image.shape[:2]:
                    raise ValueError(
                        f"{frame.depth}: size {depth.shape} differs from {image.shape[:2]} of {frame.colour.name}: "
                        "projected depth must have the colour image's size; project it anew or delete it"
                    )
            else:
                depth, pose = _carry_to_colour(depth, matrix, image.shape[:2]), _shifted(pose)
            images.append(image)
            depths.append(depth)
            intrinsics.append(matrix)
            extrinsics.append(pose)
        return Frames(
            images=np.stack(images),
            depth=np.stack(depths),
            intrinsics=np.stack(intrinsics).astype(np.float32),
            extrinsics=np.stack(extrinsics).astype(np.float32),
            metric=True,
        )

    def _listed(self, sequence: str) -> list[_Frame]:
        check_sequence(sequence, self._folders, "7-Scenes")
        if sequence not in self._frames:
            self._frames[sequence] = _list_frames(self._folders[sequence])
        return self._frames[sequence]


def _scenes(root: Path) -> list[Path]:
    if not root.is_dir():
        raise FileNotFoundError(f"{root}: no such folder; pass the folder that holds the scenes of 7-Scenes")
    own = _sequence_folders(root)
    scenes = sorted(folder for folder in root.iterdir() if folder.is_dir() and _sequence_folders(folder))
    if own and scenes:
        raise ValueError(
            f"{root} holds sequences ({own[0].name}) and scenes ({scenes[0].name}) side by side: "
            "pass the folder that holds only scenes, or one scene's folder"
        )
    if not own and not scenes:
        raise FileNotFoundError(
            f"{root}: no 7-Scenes sequences; expected {root}/<scene>/seq-XX or {root}/seq-XX (unpack the "
            "sequences' zip files)"
        )
    return [root] if own else scenes


def _sequence_folders(scene: Path) -> list[Path]:
    return sorted(f for f in scene.iterdir() if f.is_dir() and _SEQUENCE.fullmatch(f.name))


def _listed_folders(scene: Path, split: str) -> list[Path]:
    path = scene / _LIST_FILES[split]
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; add the scene's list file or choose split='all'")
    folders = []
    for line in filter(None, map(str.strip, path.read_text().splitlines())):
        match = _LIST_LINE.fullmatch(line)
        if match is None:
            raise ValueError(f"{path}: expected lines like 'sequence1', got {line!r}: restore the original file")
        folder = scene / f"seq-{int(match[1]):02d}"
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: no such folder, but {path.name} lists it; unpack it or edit the list")
        folders.append(folder)
    return sorted(set(folders))


def _list_frames(folder: Path) -> list[_Frame]:
    kinds: dict[str, set[str]] = {}
    for path in folder.iterdir():
        if match := _FRAME_FILE.fullmatch(path.name):
            kinds.setdefault(match[1], set()).add(match[2])
    if not kinds:
        raise FileNotFoundError(f"{folder}: no files like frame-000000.color.png; unpack the sequence's zip file")
    frames = []
    for name, present in sorted(kinds.items()):
        for choices in (("color.png", "color.jpg"), ("depth.proj.png", "depth.png"), ("pose.txt",)):
            if not present & set(choices):
                raise FileNotFoundError(
                    f"{folder / name}.{choices[-1]}: no such file, but frame {name} has {', '.join(sorted(present))}; "
                    "fetch it or remove the frame"
                )
        pose = _read_pose(folder / f"{name}.pose.txt")
        if pose is not None:
            colour = "color.png" if "color.png" in present else "color.jpg"
            depth = "depth.proj.png" if "depth.proj.png" in present else "depth.png"
            frames.append(_Frame(name, folder / f"{name}.{colour}", folder / f"{name}.{depth}", pose))
    return frames


def _read_pose(path: Path) -> np.ndarray | None:
    """World-to-camera [4, 4] float64, or None where the file holds a non-finite pose."""
    try:
        values = [float(word) for word in path.read_text().split()]
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected 16 numbers (camera-to-world, 4 x 4): {error}; fetch it again") from error
    if len(values) != 16:
        raise ValueError(f"{path}: expected 16 numbers (camera-to-world, 4 x 4), got {len(values)}: fetch it again")
    pose = np.array(values).reshape(4, 4)
    if not np.isfinite(pose).all():
        return None
    rotation = nearest_rotation(pose[:3, :3])
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-3 or np.abs(pose[:3, :3] - rotation).max() > 0.01:
        raise ValueError(
            f"{path}: not a rigid transform (a rotation to 0.01 and the last row 0 0 0 1 are expected): fetch it again"
        )
    pose[:3, :3], pose[3] = rotation, (0, 0, 0, 1)
    return invert(pose)


def _intrinsics(focal: float, size: tuple[int, int]) -> np.ndarray:
    scale_y, scale_x = size[0] / _SIZE[0], size[1] / _SIZE[1]
    cx, cy = (_CENTRE[0] + 0.5) * scale_x - 0.5, (_CENTRE[1] + 0.5) * scale_y - 0.5
    return np.array([[focal * scale_x, 0, cx], [0, focal * scale_y, cy], [0, 0, 1]])


def _metres(raw: np.ndarray) -> np.ndarray:
    """Millimetres uint16 as float32 metres, 0 where invalid (0 and 65535 in the files) or out of range."""
    # Before anything is carried or cast: 65535 is outside the range too, as 65.5 m.
    depth = raw.astype(np.float32) / np.float32(1000.0)
    return np.where((depth >= np.float32(_MIN_DEPTH)) & (depth <= _MAX_DEPTH), depth, np.float32(0.0))


def _shifted(extrinsics: np.ndarray) -> np.ndarray:
    shift = np.eye(4)
    shift[:3, 3] = COLOUR_FROM_DEPTH
    return compose(shift, extrinsics)


def _carry_to_colour(depth: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Depth camera's map [h, w] as the colour camera (`intrinsics`, `size`) sees it; 0 where no point falls."""
    points = unproject(depth.astype(np.float64), _intrinsics(_DEPTH_FOCAL, depth.shape))[depth > 0]
    points = points + COLOUR_FROM_DEPTH
    z = points[:, 2]
    u = np.rint(points[:, 0] / z * intrinsics[0, 0] + intrinsics[0, 2]).astype(np.intp)
    v = np.rint(points[:, 1] / z * intrinsics[1, 1] + intrinsics[1, 2]).astype(np.intp)
    inside = (u >= 0) & (u < size[1]) & (v >= 0) & (v < size[0])
    nearest = np.full(size, np.inf, np.float32)
    np.minimum.at(nearest.reshape(-1), (v * size[1] + u)[inside], z[inside].astype(np.float32))
    return np.where(np.isfinite(nearest), nearest, np.float32(0.0))
