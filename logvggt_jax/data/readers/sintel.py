"""MPI Sintel (Butler et al., ECCV 2012) with its depth and camera ground truth: 23 training sequences of a film.

Layout, the archives of pictures and of depth unpacked into one folder: `<root>/training/final/<sequence>/
frame_NNNN.png`, `training/depth/<sequence>/frame_NNNN.dpt`, `training/camdata_left/<sequence>/frame_NNNN.cam`, numbered
from 1. All binary values are little-endian. A `.dpt` file is the float32 tag 202021.25, int32 width and height, and
float32 z-depth row by row. A `.cam` file is the same tag, nine float64 of the intrinsic matrix and twelve of the 3 x 4
world-to-camera matrix, OpenCV axes, rows first.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, LICENCE_NOT_READ, About
from logvggt_jax.data.errors import BrokenPicture
from logvggt_jax.data.formats.calibration import world_to_camera
from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.data.formats.numbered_files import numbered_frames
from logvggt_jax.data.formats.source_files import PLAIN_NAME, SourceFiles, read_regular
from logvggt_jax.data.readers.folder_dataset import Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.errors import InputError

_TAG = np.array(202021.25, "<f4").tobytes()
_SKY = 1000.0  # metres; the film's sky is a huge number
_CAMERA_BYTES = 4 + 21 * 8


class Sintel(FolderDataset):
    """Reader of MPI Sintel's training half, pass `final`; sequences are named `alley_2`.

    Depth beyond 1000 m is sky and becomes 0, as does what is not finite or not positive; the limit of 70 m that
    evaluations use belongs to the metric. The test half has no ground truth, so the splits are `train` and `all`,
    both of them the training half.
    """

    name = "sintel"
    title = "MPI Sintel"
    expects = "training/final, training/depth and training/camdata_left (unpack both archives into one folder)"
    metric = True
    splits = ("train", "all")
    about = About(
        source="the set's site: the archive of pictures and that of depth and cameras",
        licence=LICENCE_NOT_READ,
        size="23 training sequences, of which published evaluations use 14; bytes unknown",
        roles=(EVALUATION,),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        return files.folders(self.root / "training" / "final", "the pictures of the pass 'final'", PLAIN_NAME)

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        training = self.root / "training"
        paths = numbered_frames(
            files,
            (folder, "frame_{:04d}.png"),
            (training / "depth" / sequence, "frame_{:04d}.dpt"),
            (training / "camdata_left" / sequence, "frame_{:04d}.cam"),
        )
        for image, depth, camera in paths.values():
            intrinsics, pose = _camera(files.content(camera, "the frame's camera"), camera)
            extrinsics = world_to_camera(pose, camera, stored="world_to_camera")
            yield frame(image, depth, intrinsics, extrinsics, calibration=camera)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        depth = _depth(record.depth)
        depth = np.where(depth <= _SKY, depth, np.float32(0.0))
        return read_rgb(record.image), depth, record.intrinsics


def _camera(content: bytes, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics [3, 3] and world-to-camera [3, 4], float64, of a `.cam` file."""
    _check_tag(content, path, InputError)
    if len(content) != _CAMERA_BYTES:
        raise InputError(f"{path}: expected {_CAMERA_BYTES} bytes, got {len(content)}: fetch it again")
    values = np.frombuffer(content, "<f8", offset=4).astype(np.float64)
    return values[:9].reshape(3, 3), values[9:].reshape(3, 4)


def _depth(path: Path) -> np.ndarray:
    """z-depth [H, W] float32 of a `.dpt` file, as stored."""
    content = read_regular(path)
    _check_tag(content, path, BrokenPicture)
    width, height = (int(size) for size in np.frombuffer(content[4:12].ljust(8, b"\0"), "<i4"))
    expected = 12 + 4 * width * height
    if width < 1 or height < 1 or len(content) != expected:
        raise BrokenPicture(
            f"{path}: expected {expected} bytes for {width} x {height} pixels, got {len(content)}: fetch it again"
        )
    return np.frombuffer(content, "<f4", offset=12).astype(np.float32).reshape(height, width)


def _check_tag(content: bytes, path: Path, error: type[InputError]) -> None:
    if content[:4] != _TAG:
        raise error(f"{path}: expected the tag 202021.25 in the first four bytes: fetch it again")
