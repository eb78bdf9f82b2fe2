"""Spring (Mehl et al., CVPR 2023): 37 training sequences, 5,000 frames, of a Blender film in stereo.

Layout: `<root>/train/NNNN/` with `frame_left/frame_left_NNNN.png`, numbered from 1, `disp1_left/disp1_left_NNNN.dsp5`
and `cam_data/{intrinsics.txt, extrinsics.txt}`. A `.dsp5` file is HDF5 with the array `disparity` at twice the
picture's width and height, in pixels of the picture. The text files have a row for each frame: `fx fy cx cy` in
pixels, and sixteen numbers of the world-to-camera matrix of the left camera, rows first, OpenCV axes, metres.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import TRAINING, About
from logvggt_jax.data.errors import UnequalCounts
from logvggt_jax.data.formats.calibration import numbers, pinhole, world_to_camera
from logvggt_jax.data.formats.hdf5 import read_hdf5
from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.data.formats.numbered_files import numbered_frames
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.errors import InputError

_BASELINE = 0.065  # metres between the two cameras
_SEQUENCE = re.compile(r"\d{4}")


class Spring(FolderDataset):
    """Reader of the left camera of Spring's training half; sequences are named `0001`.

    Depth is fx * 0.065 m over every second value of every second row of the disparity, the values that lie on the
    picture's pixels. It is 0 where the disparity is NaN or not positive, as in the sky. The test half has neither
    depth nor extrinsics, so the splits are `train` and `all`, both of them the training half.
    """

    name = "spring"
    title = "Spring"
    expects = "train/NNNN with frame_left, disp1_left and cam_data (unpack these three archives into one folder)"
    metric = True
    splits = ("train", "all")
    about = About(
        source="the benchmark's site or DaRUS (doi 10.18419/darus-3376): frame_left, disp1_left and cam_data",
        licence="CC BY 4.0 (inferred)",
        size="37 training sequences, 5,000 frames; the 10 test sequences have no depth; bytes unknown",
        roles=(TRAINING,),
        extra="data",
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        return files.folders(self.root / "train", "the training sequences", _SEQUENCE)

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        paths = numbered_frames(
            files, (folder / "frame_left", "frame_left_{:04d}.png"), (folder / "disp1_left", "disp1_left_{:04d}.dsp5")
        )
        calibration, poses = folder / "cam_data" / "intrinsics.txt", folder / "cam_data" / "extrinsics.txt"
        pinholes = _rows(files, calibration, 4, "fx fy cx cy of each frame")
        matrices = _rows(files, poses, 16, "the world-to-camera matrix of each frame")
        for path, rows in ((calibration, pinholes), (poses, matrices)):
            if max(paths) > len(rows):
                raise UnequalCounts(
                    f"{path}: expected a row for each of the frames 1 to {max(paths)}, got {len(rows)} rows: "
                    "fetch the sequence's cam_data again"
                )
        if 0 in paths:
            raise InputError(f"{paths[0][0]}: frames are numbered from 1: restore the original names")
        for number, (image, disparity) in paths.items():
            row = number - 1
            where = f"{poses}, row {number}"
            extrinsics = world_to_camera(matrices[row].reshape(4, 4), where, stored="world_to_camera")
            yield frame(image, disparity, pinhole(*pinholes[row]), extrinsics, calibration=calibration)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        height, width = image.shape[:2]
        disparity = read_hdf5(record.depth, "disparity", shape=(2 * height, 2 * width))[::2, ::2].astype(np.float32)
        # What is next to nothing is the sky too: its depth is beyond float32.
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            depth = np.float32(record.intrinsics[0, 0] * _BASELINE) / disparity
        return image, depth, record.intrinsics


def _rows(files: SourceFiles, path: Path, columns: int, expected: str) -> np.ndarray:
    """Rows [N, columns] float64 of a text file."""
    lines = [line for line in files.text(path, expected).splitlines() if line.strip()]
    if not lines:
        raise InputError(f"{path}: empty; expected {expected}: fetch it again")
    return np.stack([numbers(line, f"{path}, row {row}", count=columns) for row, line in enumerate(lines, 1)])
