"""Virtual KITTI 2 (Cabon et al., 2020), version 2.0.3: five synthetic drives, ten variations, two cameras.

Layout, the archives of pictures, depth and text ground truth unpacked into one folder: `<root>/SceneNN/<variation>/`
with `frames/rgb/Camera_N/rgb_NNNNN.jpg`, `frames/depth/Camera_N/depth_NNNNN.png`, `intrinsic.txt` and `extrinsic.txt`.
After a header line, `intrinsic.txt` has rows `frame camera fx fy cx cy` (pixels) and `extrinsic.txt` rows `frame
camera` and sixteen numbers of the world-to-camera matrix, rows first, OpenCV axes, metres; both cameras' rows are
interleaved. Depth is 16-bit z in centimetres, 65535 in the sky and beyond 655.35 m.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, TRAINING, About
from logvggt_jax.data.formats.calibration import numbers, pinhole, whole_number, world_to_camera
from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.data.formats.numbered_files import numbered_frames
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.errors import InputError

_SCENE = re.compile(r"Scene\d{2}")
_VARIATION = re.compile("(15|30)-deg-(left|right)|clone|fog|morning|overcast|rain|sunset")
_CAMERAS = ("Camera_0", "Camera_1")
_TEST_SCENE = "Scene20"
_SKY = 65535


class VirtualKITTI(FolderDataset):
    """Reader of Virtual KITTI 2; each camera is a sequence of its own, named `Scene01/clone/Camera_0`.

    Depth is 0 where the files have 0 or 65535. The set has no official lists; as in published training code its last
    scene, Scene20, is the split `test` and the others are `train`.
    """

    name = "virtual_kitti"
    title = "Virtual KITTI 2"
    expects = "SceneNN/<variation>/frames with rgb and depth (unpack rgb, depth and textgt into one folder)"
    metric = True
    splits = ("train", "test", "all")
    about = About(
        source="its owners' page: the archives of pictures, depth and text ground truth of version 2.0.3",
        licence="CC BY-NC-SA 3.0",
        size="21,260 stereo pairs: 5 scenes in 10 variations, 2 cameras; bytes unknown",
        roles=(TRAINING, EVALUATION),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        scenes = [name for name in files.names(self.root, "the scenes") if _SCENE.fullmatch(name)]
        if self.split != "all":
            scenes = [name for name in scenes if (name == _TEST_SCENE) == (self.split == "test")]
        return {
            f"{scene}/{variation}/{camera}": self.root / scene / variation
            for scene in scenes
            for variation in files.names(self.root / scene, "the scene's variations")
            if _VARIATION.fullmatch(variation)
            for camera in files.names(self.root / scene / variation / "frames" / "rgb", "folders Camera_0 and Camera_1")
            if camera in _CAMERAS
        }

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        camera = sequence.rpartition("/")[2]
        index = int(camera.removeprefix("Camera_"))
        paths = numbered_frames(
            files,
            (folder / "frames" / "rgb" / camera, "rgb_{:05d}.jpg"),
            (folder / "frames" / "depth" / camera, "depth_{:05d}.png"),
        )
        calibration, poses = folder / "intrinsic.txt", folder / "extrinsic.txt"
        pinholes = _rows(files, calibration, index, columns=4)
        matrices = _rows(files, poses, index, columns=16)
        for number, (image, depth) in paths.items():
            for path, rows in ((calibration, pinholes), (poses, matrices)):
                if number not in rows:
                    raise InputError(
                        f"{path}: no row for frame {number} of {camera}: fetch the text ground truth again"
                    )
            where = f"{poses}, frame {number} of {camera}"
            extrinsics = world_to_camera(matrices[number].reshape(4, 4), where, stored="world_to_camera")
            yield frame(image, depth, pinhole(*pinholes[number]), extrinsics, calibration=calibration)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        raw = read_depth(record.depth)
        depth = raw.astype(np.float32) / np.float32(100.0)
        return read_rgb(record.image), np.where(raw != _SKY, depth, np.float32(0.0)), record.intrinsics


def _rows(files: SourceFiles, path: Path, camera: int, *, columns: int) -> dict[int, np.ndarray]:
    """One camera's rows of a text file by frame, each [columns] float64."""
    rows: dict[int, np.ndarray] = {}
    header, *lines = files.text(path, "the text ground truth (archive textgt)").splitlines() or [""]
    if not header.startswith("frame cameraID"):
        raise InputError(f"{path}: expected a header 'frame cameraID ...', got {header[:40]!r}: fetch it again")
    for line_number, line in enumerate(lines, 2):
        if line.strip():
            values = numbers(line, f"{path}, line {line_number}", count=2 + columns)
            number, of_camera = (whole_number(value, f"{path}, line {line_number}") for value in values[:2])
            if of_camera == camera:
                rows[number] = values[2:]
    return rows
