"""Recordings of one's own whose cameras COLMAP has found.

Layout: the root is such a recording, or holds folders that are. A recording holds

- `sparse/0/` (as the mapper writes it) or `sparse/` (as the undistorter does) with `cameras` and `images`, `.bin` or
  `.txt`; of several models (`sparse/0/`, `sparse/1/`, …) the one with most pictures is read;
- `images/`, the pictures that the model names;
- for depth, if any, `depth/<picture's name without suffix>.png`, 16-bit, thousandths of the model's unit of length; or
  `stereo/depth_maps/<picture's name>.geometric.bin` as COLMAP's `patch_match_stereo` writes them; 0 where invalid.

Poses are world-to-camera, OpenCV axes, in a unit of the model's own.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, TRAINING, About
from logvggt_jax.data.formats.calibration import in_pixels, relative
from logvggt_jax.data.formats.colmap_model import (
    ColmapCamera,
    choose_model,
    read_cameras,
    read_depth_map,
    read_images,
)
from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.data.formats.lens import Lens
from logvggt_jax.data.formats.ordering import natural_order
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import Dropped, FolderDataset, FrameRecord, frame, read_depth_of
from logvggt_jax.data.readers.own_recordings import (
    find_recordings,
    is_picture,
    names_beside,
    pictures_below,
    without_distortion,
)
from logvggt_jax.errors import InputError

_DEPTH_UNITS = 1000.0


class Colmap(FolderDataset):
    """Reader of COLMAP's models; sequences are named as their folders, frames as their pictures.

    Frames are in the natural order of their names (`img2` before `img10`). Pictures that COLMAP has not registered (`no
    pose`) do not count, nor do those without depth where the recording has any (`no depth`); without any, the frames'
    depth is 0 throughout, no pixel valid. Pictures may be resized copies: the intrinsics follow their size.

    Lens distortion is taken out while a frame is read: picture and depth are those of a pinhole of the same size, focal
    lengths and principal point, where nothing was seen black with depth 0. That is so for OpenCV's models:
    `SIMPLE_RADIAL`, `RADIAL`, `OPENCV`, `FULL_OPENCV`, and `OPENCV_FISHEYE` with its simpler forms; others are refused.
    """

    name = "colmap"
    title = "own recordings with COLMAP's cameras"
    expects = "sparse/0 with cameras and images (.bin or .txt), and images; for depth stereo/depth_maps or depth"
    metric = False
    splits = ("all",)
    own = True
    about = About(
        source="photograph it and run COLMAP",
        licence="your own",
        size="your own",
        roles=(TRAINING, EVALUATION),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        return find_recordings(self.root, files, self.expects, lambda folder: files.exists(folder / "sparse"))

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        sparse, pictures = folder / "sparse", folder / "images"
        model, said = choose_model(files, sparse)
        if said:
            files.remark(said)
        camera_file, cameras = read_cameras(files, model)
        image_file, images = read_images(files, model)
        images = [images[position] for position in natural_order([image.name for image in images])]
        paths = pictures_below(pictures, [image.name for image in images], image_file)
        names = [path.relative_to(pictures).as_posix() for path in paths]
        held = {pictures: set(files.names(pictures, self.expects)), **names_beside(files, paths, image_file)}
        used = {image.camera for image in images}
        known = {number: _camera(cameras, number, camera_file, image_file) for number in used}
        there = {each / name for each, inside in held.items() for name in inside}
        yield from (Dropped("no pose") for path in there - set(paths) if is_picture(path))
        depths = _depth_files(files, folder, names)
        for image, name, path in zip(images, names, paths, strict=True):
            depth = depths.get(name) if depths else path  # a picture in depth's place stands for no depth
            if depth is None:
                yield Dropped("no depth")
                continue
            intrinsics, lens = known[image.camera]
            others = {"name": name, "calibration": camera_file, "lens": lens.row}
            yield frame(path, depth, intrinsics, image.extrinsics, **others)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        is_map = record.depth.suffix == ".bin"
        depth = read_depth_map(record.depth) if is_map else read_depth_of(record, image, _DEPTH_UNITS)
        intrinsics = in_pixels(record.intrinsics, image.shape[:2], record.image, record.calibration)
        return without_distortion(record, image, depth, intrinsics)


def _camera(cameras: Mapping[int, ColmapCamera], number: int, path: Path, image_file: Path) -> tuple[np.ndarray, Lens]:
    """Intrinsics [3, 3] of a picture of one pixel, and the lens."""
    if number not in cameras:
        raise InputError(f"{path}: no camera {number}, which {image_file} names: export the model again")
    camera = cameras[number]
    known = camera.pinhole_and_lens()
    if known is None:
        raise InputError(
            f"{path}: camera {number} is {camera.model} with distortion that is not among OpenCV's: run `colmap "
            f"image_undistorter --image_path <images> --input_path {path.parent} --output_path <new folder>` and pass "
            "the new folder"
        )
    matrix, lens = known
    return relative(matrix, camera.size), lens


def _depth_files(files: SourceFiles, folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Files of depth by the picture's name, for the pictures that have one; all of one kind."""
    maps, own = folder / "stereo" / "depth_maps", folder / "depth"
    for candidates in (
        {name: own / PurePosixPath(name).with_suffix(".png") for name in names},
        {name: maps / f"{name}.geometric.bin" for name in names},
    ):
        folders = {path.parent for path in candidates.values()}
        held = {each: set(files.names(each, "depth")) for each in folders if files.exists(each)}
        found = {name: path for name, path in candidates.items() if path.name in held.get(path.parent, ())}
        if found:
            return found
    return {}
