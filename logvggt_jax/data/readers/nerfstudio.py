"""Recordings of one's own in the form of nerfstudio: `transforms.json` with the cameras, pictures, and depth if any.

Layout: the root is such a recording, or holds folders that are. `transforms.json` holds

- `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`, for all frames, or in each of them where cameras differ; pixels, the centre of
  the first one at (0.5, 0.5). Of distortion `k1`, `k2`, `k3`, `p1`, `p2`, or with the `camera_model` `OPENCV_FISHEYE`
  (or instant-ngp's `is_fisheye`) `k1` … `k4`, each 0 where it is left out; other models than `PINHOLE`,
  `SIMPLE_PINHOLE`, `SIMPLE_RADIAL`, `RADIAL`, `OPENCV` and that are refused;
- `frames`, each with a `file_path` relative to the recording (its suffix may be left out), a `transform_matrix`
  (camera-to-world, [4, 4], axes of OpenGL: x right, y up, z back) and for depth a `depth_file_path`: 16-bit,
  thousandths of the poses' unit of length, 0 where invalid, z and not ray length;
- `applied_scale`, if any: what the poses were multiplied by after depth was measured. Depth is multiplied by it, as
  nerfstudio does; an `applied_transform` scales nothing.
"""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, TRAINING, About
from logvggt_jax.data.formats.calibration import OPENGL_AXES, in_pixels, relative, world_to_camera
from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.data.formats.json_values import expecting, read_json, text_of
from logvggt_jax.data.formats.lens import Lens
from logvggt_jax.data.formats.nerfstudio_transforms import CAMERA, TRANSFORMS_FILE, camera_of, lens_of
from logvggt_jax.data.formats.ordering import natural_order
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import Dropped, FolderDataset, FrameRecord, frame, read_depth_of
from logvggt_jax.data.readers.own_recordings import (
    file_below,
    find_recordings,
    names_beside,
    pictures_below,
    with_suffixes,
    without_distortion,
)
from logvggt_jax.errors import InputError

_DEPTH_UNITS = 1000.0
_MAX_SCALE = 1e6


class Nerfstudio(FolderDataset):
    """Reader of nerfstudio's recordings; sequences are named as their folders, frames as their pictures.

    Frames are in the natural order of their names (`img2` before `img10`). Where some have depth those without it do
    not count (`no depth`); where none has, depth is 0 throughout, no pixel valid. Pictures may be resized copies: the
    intrinsics follow their size.

    Lens distortion is taken out while a frame is read: picture and depth are those of a pinhole of the same size, focal
    lengths and principal point, where nothing was seen black with depth 0.
    """

    name = "nerfstudio"
    title = "own recordings in nerfstudio's form"
    expects = f"{TRANSFORMS_FILE} with cameras and frames, and the pictures and depth that it names, or folders that do"
    metric = False
    splits = ("all",)
    own = True
    about = About(
        source="`ns-process-data` and apps that export nerfstudio's form",
        licence="your own",
        size="your own",
        roles=(TRAINING, EVALUATION),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        return find_recordings(self.root, files, self.expects, lambda folder: files.exists(folder / TRANSFORMS_FILE))

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        path = folder / TRANSFORMS_FILE
        content = read_json(files.text(path, "cameras and frames in nerfstudio's form"), path)
        with expecting(path, "an object with a list of frames"):
            entries = [{**content, **entry} for entry in content["frames"]]
            images = pictures_below(folder, [text_of(entry["file_path"]) for entry in entries], path)
            depths = [
                file_below(folder, text_of(entry["depth_file_path"]), path) if entry.get("depth_file_path") else None
                for entry in entries
            ]
        images = with_suffixes(files, images, path)
        names_beside(files, [file for file in (*images, *depths) if file is not None], path)
        names = [str(image.relative_to(folder)) for image in images]
        scale = _applied_scale(content, path)
        for place in natural_order(names):
            if depths[place] is None and any(depths):
                yield Dropped("no depth")
                continue
            where = f"{path}, frames[{place}]"
            with expecting(path, f"in frames[{place}] a camera and a transform_matrix"):
                intrinsics, lens = _camera(entries[place], where)
                pose = np.array(entries[place]["transform_matrix"], np.float64).reshape(-1, 4)
                if len(pose) not in (3, 4):
                    raise ValueError(f"a matrix of {len(pose)} x 4")
            with np.errstate(invalid="ignore"):  # of a pose that is lost
                pose = pose @ OPENGL_AXES
            extrinsics = world_to_camera(pose, where, stored="camera_to_world")
            # A picture in depth's place stands for no depth.
            depth = depths[place] or images[place]
            others = {"name": names[place], "calibration": path, "lens": lens.row, "depth_scale": scale}
            yield frame(images[place], depth, intrinsics, extrinsics, **others)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        intrinsics = in_pixels(record.intrinsics, image.shape[:2], record.image, record.calibration)
        depth = read_depth_of(record, image, _DEPTH_UNITS / record.depth_scale)
        return without_distortion(record, image, depth, intrinsics)


def _applied_scale(content: Mapping[str, Any], path: Path) -> float:
    with expecting(path, "a number as applied_scale"):
        scale = float(content.get("applied_scale", 1.0))
    if not 1 / _MAX_SCALE <= scale <= _MAX_SCALE:
        raise InputError(f"{path}: applied_scale={scale:g} cannot be what poses were multiplied by: edit the file")
    return scale


def _camera(entry: Mapping[str, Any], where: str) -> tuple[np.ndarray, Lens]:
    """Intrinsics [3, 3] of a picture of one pixel, and the lens; the frame's own values come before those for all."""
    lens = lens_of(entry)
    if lens is None or not np.isfinite(lens.coefficients).all():
        raise InputError(
            f"{where}: {entry.get('camera_model', 'PINHOLE')} with distortion that is not among OpenCV's: undistort "
            "the pictures (`colmap image_undistorter`; its output folder can be read as `colmap`)"
        )
    if absent := [name for name in CAMERA if name not in entry]:
        raise InputError(f"{where}: no {', '.join(absent)}, neither here nor for all frames: add what is missing")
    intrinsics, height, width = camera_of(entry)
    if not (width >= 1 and height >= 1 and math.isfinite(width * height)):
        raise InputError(f"{where}: pictures of w={width:g} x h={height:g} do not exist: edit the file")
    return relative(intrinsics, (int(height), int(width))), lens
