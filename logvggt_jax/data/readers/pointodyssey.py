"""PointOdyssey v1.2 (Zheng et al., ICCV 2023): 159 long synthetic videos of moving people, animals and things.

Layout: `<root>/{train,val,test}/<sequence>/` with `rgbs/rgb_NNNNN.jpg`, `depths/depth_NNNNN.png` and `anno.npz`. Of
the latter's arrays `intrinsics` [T, 3, 3] (pixels) and `extrinsics` [T, 4, 4] (world-to-camera, OpenCV, metres) are
read; the point tracks beside them, a hundred times larger, are not. Depth is 16-bit, 65535 for 1000 m.
"""

import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import TRAINING, About
from logvggt_jax.data.errors import MissingFiles, UnequalCounts
from logvggt_jax.data.formats.calibration import world_to_camera
from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.data.formats.numbered_files import numbered_frames
from logvggt_jax.data.formats.source_files import PLAIN_NAME, SourceFiles
from logvggt_jax.data.readers.folder_dataset import Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.errors import InputError
from logvggt_jax.files import numpy_reading

_FULL_SCALE, _FAR = 65535, 1000.0  # the stored value of `_FAR` metres
_SPLITS = ("train", "val", "test")
# Only in the archives of later releases; v1.0 has other camera axes under the same names.
_LATER_ARRAY = "valids"


class PointOdyssey(FolderDataset):
    """Reader of PointOdyssey v1.2; sequences are named `train/dancing`; the splits are the set's folders.

    Depth is 0 where the files have 0 or 65535 (1000 m and beyond: the sky). Pictures, depth and cameras must be equal
    in number, as the row of the cameras is the number in the file name. Version 1.0 used other camera axes; what
    tells it apart, the file name `annotations.npz` or the lack of the array `valids`, is refused.
    """

    name = "pointodyssey"
    title = "PointOdyssey"
    expects = "train, val or test with <sequence>/rgbs, depths and anno.npz of v1.2"
    metric = True
    splits = (*_SPLITS, "all")
    about = About(
        source="project page (repository y-zheng18/point_odyssey), release v1.2; v1.0 is refused",
        licence="CC BY-NC-SA 4.0",
        size="159 videos (131 train, 15 val, 13 test); bytes unknown",
        roles=(TRAINING,),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        chosen = [self.split] if self.split != "all" else [s for s in _SPLITS if files.exists(self.root / s)]
        return {
            f"{split}/{name}": folder
            for split in chosen
            for name, folder in files.folders(
                self.root / split, f"the sequences of this split of {self.title}", PLAIN_NAME
            ).items()
        }

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        intrinsics, extrinsics = _cameras(files, folder)
        paths = numbered_frames(files, (folder / "rgbs", "rgb_{:05d}.jpg"), (folder / "depths", "depth_{:05d}.png"))
        if list(paths) != list(range(len(extrinsics))):
            raise UnequalCounts(
                f"{folder}: expected frames 0 to {len(extrinsics) - 1}, as many as anno.npz has cameras, got "
                f"{len(paths)} frames from {min(paths)} to {max(paths)}: fetch the sequence again or remove its folder"
            )
        for number, (image, depth) in paths.items():
            where = f"{folder / 'anno.npz'}, extrinsics of frame {number}"
            pose = world_to_camera(extrinsics[number], where, stored="world_to_camera")
            yield frame(image, depth, intrinsics[number], pose, calibration=folder / "anno.npz")

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        raw = read_depth(record.depth)
        depth = raw.astype(np.float32) * np.float32(_FAR / _FULL_SCALE)
        return read_rgb(record.image), np.where(raw < _FULL_SCALE, depth, np.float32(0.0)), record.intrinsics


def _cameras(files: SourceFiles, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics [T, 3, 3] and extrinsics [T, 4, 4], float64, of `anno.npz`; its other arrays are left unread."""
    path = folder / "anno.npz"
    if not files.exists(path):
        older = files.exists(folder / "annotations.npz")
        raise MissingFiles(
            f"{path}: no such file; "
            + ("annotations.npz is of an older release with other cameras: fetch v1.2" if older else "fetch it again")
        )
    files.regular(path, "the sequence's cameras")
    if not zipfile.is_zipfile(path):
        raise InputError(f"{path}: truncated or damaged npz file (no zip directory): fetch it again")
    try:
        with path.open("rb") as file, numpy_reading(), np.load(file, allow_pickle=False) as archive:
            names = archive.files
            # What has no array's header comes as bytes.
            found = {name: np.asarray(archive[name]) for name in ("intrinsics", "extrinsics") if name in names}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: truncated or damaged npz file ({error}): fetch it again") from error
    if len(found) < 2 or _LATER_ARRAY not in names:
        raise InputError(
            f"{path}: expected the arrays intrinsics, extrinsics and {_LATER_ARRAY} of v1.2, got {', '.join(names)}; "
            "older releases have other cameras: fetch v1.2"
        )
    count = len(found["extrinsics"]) if found["extrinsics"].ndim else 0
    for name, size in (("intrinsics", 3), ("extrinsics", 4)):
        array = found[name]
        if array.shape != (count, size, size) or not count or array.dtype.kind not in "iuf":
            raise InputError(
                f"{path}: expected {name} of {size} x {size} numbers for each frame, got {array.dtype} {array.shape}: "
                "fetch it again"
            )
    return found["intrinsics"].astype(np.float64), found["extrinsics"].astype(np.float64)
