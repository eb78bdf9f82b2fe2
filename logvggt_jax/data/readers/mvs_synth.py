"""MVS-Synth (Huang et al., CVPR 2018, "DeepMVS"): 120 sequences of 100 frames from the game GTA V.

Layout, as on the DeepMVS project page: `<root>/GTAV_720/NNNN/{images/NNNN.png, depths/NNNN.exr, poses/NNNN.json}`.
A pose file holds `extrinsic` (4 x 4 rows, world-to-camera, OpenCV camera, left-handed world) and `f_x, f_y, c_x, c_y`
in pixels. Depth is z in units of about 0.1 m, infinite in the sky. Of the three sizes published, 720 is read: the
intrinsics stored with GTAV_540 do not fit its pictures.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import TRAINING, About
from logvggt_jax.data.formats.calibration import pinhole, world_to_camera
from logvggt_jax.data.formats.exr import read_exr
from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.data.formats.json_values import expecting, read_json
from logvggt_jax.data.formats.numbered_files import numbered_frames
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.errors import InputError

# Makes the world right-handed; which axis is flipped changes no relative pose.
_MIRROR = np.array([1.0, -1.0, 1.0, 1.0])  # of the columns
_SEQUENCE = re.compile(r"\d{4}")
_NUMBERS = ("f_x", "f_y", "c_x", "c_y")


class MVSSynth(FolderDataset):
    """Reader of MVS-Synth; sequences are named `0000`.

    Depth and translations stay in the set's own unit, so the set is not metric. Depth that is infinite (sky), NaN or
    not positive becomes 0. The left-handed world is mirrored at y = 0, which makes the extrinsics rotations; stored
    extrinsics with determinant +1 are refused. The set has no lists, so the only split is `all`.
    """

    name = "mvs_synth"
    title = "MVS-Synth"
    expects = "GTAV_720/NNNN with images, depths and poses (unpack GTAV_720.tar.gz)"
    metric = False
    splits = ("all",)
    about = About(
        source="DeepMVS project page (repository phuang17/DeepMVS); only GTAV_720 is read",
        licence="unknown",
        size="120 sequences of 100 frames; bytes unknown",
        roles=(TRAINING,),
        extra="data",
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        expected = f"the sequences of {self.title} at 1280 x 720; other sizes are not read"
        return files.folders(self.root / "GTAV_720", expected, _SEQUENCE)

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        kinds = (("images", "{:04d}.png"), ("depths", "{:04d}.exr"), ("poses", "{:04d}.json"))
        paths = numbered_frames(files, *((folder / kind, template) for kind, template in kinds))
        for image, depth, pose in paths.values():
            camera = _camera(files.text(pose, "the frame's camera"), pose)
            yield frame(image, depth, *camera, calibration=pose)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return read_rgb(record.image), read_exr(record.depth), record.intrinsics


def _camera(text: str, path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Intrinsics [3, 3] and extrinsics [4, 4] (None where not finite) of a pose file, in a right-handed world."""
    stored = read_json(text, path)
    with expecting(path, f"JSON with 'extrinsic' and {', '.join(_NUMBERS)}"):
        pose = np.array(stored["extrinsic"], np.float64)
        intrinsics = pinhole(*(float(stored[key]) for key in _NUMBERS))
    if pose.shape != (4, 4):
        raise InputError(f"{path}: expected an extrinsic of 4 x 4 numbers, got {pose.shape}: fetch it again")
    if np.isfinite(pose).all() and np.linalg.det(pose) > 0:
        raise InputError(
            f"{path}: expected a left-handed world (determinant -1), got determinant "
            f"{np.linalg.det(pose):+.3g}: replace it with the data set's original file"
        )
    return intrinsics, world_to_camera(pose * _MIRROR, path, stored="world_to_camera")
