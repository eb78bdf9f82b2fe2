"""HyperSim (Roberts et al., ICCV 2021): 74,619 rendered pictures of 457 indoor scenes.

Layout: `<root>/ai_VVV_NNN/` with `_detail/metadata_scene.csv`, `_detail/cam_XX/camera_keyframe_{positions,
orientations}.hdf5`, `images/scene_cam_XX_final_hdf5/frame.IIII.color.hdf5` and `images/scene_cam_XX_geometry_hdf5/
frame.IIII.{depth_meters,render_entity_id}.hdf5`; beside the scenes two tables of the set's repository,
`metadata_camera_parameters.csv` and, for splits, `metadata_images_split_scene_v1.csv`. Each HDF5 file holds one array
named `dataset`. Orientations are camera-to-world with OpenGL axes, positions in asset units
(`meters_per_asset_unit`), both indexed by the frame number in the file name. Depth is the distance to the camera's
centre in metres, colour is linear and of high dynamic range.

The renderer's cameras are tilted and shifted lenses: the matrix `M_cam_from_uv` takes (u, v, 1), both within -1 and 1
over the picture and v up, to a ray of the OpenGL camera, and its image plane need not face the optical axis. `M` =
S inv(M_cam_from_uv) diag(1, -1, -1), with S from (u, v) to pixels, takes points of the camera with OpenCV axes to
pixels, and splits exactly into upper triangular intrinsics K and a rotation Q. The camera handed out is the one
turned by Q.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from absl import logging

from logvggt_jax.data.dataset import TRAINING, About
from logvggt_jax.data.errors import UnequalCounts
from logvggt_jax.data.formats.calibration import OPENGL_AXES, world_to_camera
from logvggt_jax.data.formats.hdf5 import read_hdf5
from logvggt_jax.data.formats.numbered_files import numbered_frames
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import INDOORS, Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.errors import InputError

_CAMERA_TABLE = "metadata_camera_parameters.csv"
_SPLIT_TABLE = "metadata_images_split_scene_v1.csv"
_SCENE = re.compile(r"ai_\d{3}_\d{3}")
_FINAL_FOLDER = re.compile(r"scene_(cam_\d{2})_final_hdf5")
_MAX_SKEW = 0.5  # pixels
# The set's tone map: this percentile of the brightness becomes this grey.
_PERCENTILE, _GREY, _GAMMA = 90, 0.8, 2.2
_LUMA = np.array([0.3, 0.59, 0.11], np.float32)
_DARK = 1e-4
_MAX_SCALE = 1e6  # asset units a metre, or the reverse


class HyperSim(FolderDataset):
    """Reader of HyperSim; each camera path is a sequence, named `ai_001_001/cam_00`.

    Cameras are exact pinholes (see the module's text): intrinsics K, extrinsics [Q | 0] times those stored, in metres,
    and z-depth = distance / |K^-1 (u, v, 1)|. Intrinsics follow the size of the picture. Depth that is not finite or
    not positive becomes 0. Pictures are tone-mapped as the set's owners do, by the pixels that show an object, and
    truncated to 8 bits. Cameras whose pixels are skewed by more than 0.5 pixels (25 of the table's 482 scenes) are
    left out, as frames carry no skew; `skewed_sequences` lists them. The splits are those of version 1, by scene, for
    the scenes that are there: the set is often fetched in part.
    """

    name = "hypersim"
    title = "HyperSim"
    expects = f"ai_VVV_NNN with _detail and images, and {_CAMERA_TABLE} from the set's repository"
    metric = True
    plausible_depth = INDOORS
    centred = False  # shifted lenses
    splits = ("train", "val", "test", "all")
    about = About(
        source="download script of the repository apple/ml-hypersim, a zip file a scene (parts of scenes: "
        "contrib/99991); metadata_camera_parameters.csv from contrib/mikeroberts3000 and, for splits, "
        "metadata_images_split_scene_v1.csv from evermotion_dataset/analysis",
        licence="CC BY-SA 3.0",
        size="1.9 TB; 74,619 pictures of 457 scenes",
        roles=(TRAINING,),
        extra="data",
    )

    def skewed_sequences(self) -> list[str]:
        """Sequences of the split that are on disk and left out because of skewed pixels."""
        return [name for name, _, camera in self._on_disk(SourceFiles()) if camera.skew > _MAX_SKEW]

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        found = list(self._on_disk(files))
        kept = {name: folder for name, folder, camera in found if camera.skew <= _MAX_SKEW}
        if len(kept) < len(found):
            logging.info("%s: %d cameras with skewed pixels are left out", self.title, len(found) - len(kept))
        return kept

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        scene, camera_name = sequence.split("/")
        camera = _camera(_table_lines(files, self.root / _CAMERA_TABLE), scene, self.root / _CAMERA_TABLE)
        scale = _metres_per_unit(files, folder / "_detail" / "metadata_scene.csv")
        detail = folder / "_detail" / camera_name
        orientation_file = detail / "camera_keyframe_orientations.hdf5"
        orientations = _keyframes(files, orientation_file, (None, 3, 3))
        positions = _keyframes(files, detail / "camera_keyframe_positions.hdf5", (len(orientations), 3)) * scale
        final, geometry = (folder / "images" / f"scene_{camera_name}_{kind}_hdf5" for kind in ("final", "geometry"))
        paths = numbered_frames(
            files,
            (final, "frame.{:04d}.color.hdf5"),
            (geometry, "frame.{:04d}.depth_meters.hdf5"),
            (geometry, "frame.{:04d}.render_entity_id.hdf5"),
        )
        if max(paths) >= len(positions):
            raise UnequalCounts(
                f"{detail}: expected a keyframe for each frame up to {max(paths)}, got {len(positions)}: "
                "fetch the scene again"
            )
        turn = np.eye(4)
        turn[:3, :3] = camera.rotation
        for number, (image, distance, entities) in paths.items():
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = orientations[number], positions[number]
            where = f"{orientation_file}, keyframe {number}"
            stored = world_to_camera(pose @ OPENGL_AXES, where, stored="camera_to_world")
            extrinsics = None if stored is None else turn @ stored
            name = f"frame.{number:04d}"
            others = {"name": name, "companion": entities, "calibration": self.root / _CAMERA_TABLE}
            yield frame(image, distance, camera.intrinsics, extrinsics, **others)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        with np.errstate(over="ignore", invalid="ignore"):  # damaged colour is told apart by the tone map
            colour = read_hdf5(record.image, "dataset", shape=(None, None, 3)).astype(np.float32)
        size = colour.shape[:2]
        with np.errstate(invalid="ignore"):
            distance = read_hdf5(record.depth, "dataset", shape=size).astype(np.float64)
        assert record.companion is not None
        shown = read_hdf5(record.companion, "dataset", shape=size) != -1
        intrinsics = _pixels_from_plane(size) @ record.intrinsics
        v, u = np.indices(size)
        rays = np.stack([u, v, np.ones(size)], -1) @ np.linalg.inv(intrinsics).T  # z = 1
        return _tone_mapped(colour, shown), distance / np.linalg.norm(rays, axis=-1), intrinsics

    def _on_disk(self, files: SourceFiles) -> Iterator[tuple[str, Path, _Camera]]:
        """Name, scene folder and camera of the split's sequences, skewed ones as well."""
        path = self.root / _CAMERA_TABLE
        table = _table_lines(files, path)
        partition = {} if self.split == "all" else _partition(files, self.root / _SPLIT_TABLE)
        for scene in files.folders(self.root, "the scenes", _SCENE):
            camera = _camera(table, scene, path)
            for folder in files.names(self.root / scene / "images", "the scene's pictures"):
                if match := _FINAL_FOLDER.fullmatch(folder):
                    name = f"{scene}/{match[1]}"
                    if self.split != "all" and name not in partition:
                        raise InputError(
                            f"{self.root / _SPLIT_TABLE}: no row for {name}, which is on disk: fetch the table again"
                        )
                    if self.split == "all" or self.split in partition[name]:
                        yield name, self.root / scene, camera


@dataclass(frozen=True)
class _Camera:
    """What the camera table says of a scene."""

    intrinsics: np.ndarray  # [3, 3], from points of the turned camera to the picture's plane, -1 to 1 across and down
    rotation: np.ndarray  # [3, 3], from the stored camera with OpenCV axes to the turned one
    skew: float  # pixels, at the table's picture width


def _table_lines(files: SourceFiles, path: Path) -> dict[str, list[str]]:
    """Header and row of each scene, not yet split into fields; fields hold commas but no line ends."""
    text = files.text(path, "the table from contrib/mikeroberts3000 of the set's repository")
    header, *lines = text.splitlines() or [""]
    return {line.partition(",")[0]: [header, line] for line in lines}


def _camera(table: Mapping[str, list[str]], scene: str, path: Path) -> _Camera:
    if scene not in table:
        raise InputError(f"{path}: no row for {scene}, which is on disk: fetch the table again")
    (row,) = csv.DictReader(table[scene])
    try:
        camera_from_uv = np.array([[float(row[f"M_cam_from_uv_{i}{j}"]) for j in range(3)] for i in range(3)])
        width = float(row["settings_output_img_width"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: expected M_cam_from_uv_00 ... 22 and settings_output_img_width of {scene} "
            f"({type(error).__name__}: {error}): fetch the table again"
        ) from error
    if not np.isfinite(camera_from_uv).all() or np.linalg.matrix_rank(camera_from_uv) < 3:
        raise InputError(f"{path}: M_cam_from_uv of {scene} has no inverse: fetch the table again")
    # From OpenCV's axes to OpenGL's, to (u, v) with v up, to v down.
    plane_from_camera = np.diag([1.0, -1.0, 1.0]) @ np.linalg.inv(camera_from_uv) @ OPENGL_AXES[:3, :3]
    if np.linalg.det(plane_from_camera) <= 0:
        raise InputError(f"{path}: M_cam_from_uv of {scene} mirrors the picture: fetch the table again")
    # With a positive determinant the triangular factor has a positive diagonal and the other is a rotation.
    _, upper, rotation, *_ = cv2.RQDecomp3x3(plane_from_camera)
    intrinsics = upper / upper[2, 2]
    return _Camera(intrinsics, rotation, abs(intrinsics[0, 1]) * width / 2)


def _pixels_from_plane(size: tuple[int, int]) -> np.ndarray:
    """[3, 3], from the picture's plane, whose borders are at -1 and 1, to pixels with centres at integers."""
    height, width = size
    return np.array([[width / 2, 0, width / 2 - 0.5], [0, height / 2, height / 2 - 0.5], [0, 0, 1]])


def _metres_per_unit(files: SourceFiles, path: Path) -> float:
    """Length of the scene's asset unit in metres."""
    rows = csv.reader(files.text(path, "the scene's asset unit").splitlines())
    stored = {row[0]: row[1] for row in rows if len(row) == 2}.get("meters_per_asset_unit", "none")
    try:
        scale = float(stored)
    except ValueError:
        scale = np.nan
    if not 1 / _MAX_SCALE <= scale <= _MAX_SCALE:
        raise InputError(f"{path}: expected a row meters_per_asset_unit with a length, got {stored}: fetch it again")
    return scale


def _keyframes(files: SourceFiles, path: Path, shape: tuple[int | None, ...]) -> np.ndarray:
    """Array of `shape` float64 with a row for each keyframe of a camera path."""
    content = files.content(path, "the camera path's keyframes")
    return read_hdf5(path, "dataset", shape=shape, content=content).astype(np.float64)


def _partition(files: SourceFiles, path: Path) -> dict[str, set[str]]:
    """Splits of each camera path by name; empty where none of its frames is in the public release."""
    text = files.text(path, "the table from evermotion_dataset/analysis of the set's repository, or split='all'")
    splits: dict[str, set[str]] = {}
    try:
        for row in csv.DictReader(text.splitlines()):
            of_path = splits.setdefault(f"{row['scene_name']}/{row['camera_name']}", set())
            if row["included_in_public_release"] == "True":
                of_path.add(row["split_partition_name"])
    except KeyError as error:
        raise InputError(f"{path}: no column {error}: fetch the table again") from error
    return splits


def _tone_mapped(colour: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Linear colour [H, W, 3] float32 as 8-bit; exposed by the pixels [H, W] that are `shown` and finite."""
    shown = shown & np.isfinite(colour).all(-1)
    scale = 1.0
    if shown.any():
        bright = float(np.percentile(colour[shown] @ _LUMA, _PERCENTILE))
        scale = _GREY**_GAMMA / bright if bright >= _DARK else 0.0
    # The files are half floats: what overflowed there is at least that bright.
    limit = float(np.finfo(np.float16).max)
    exposed = np.clip(np.nan_to_num(colour, nan=0.0, posinf=limit), 0.0, None) * np.float32(scale)
    return (np.clip(exposed, 0.0, 1.0) ** np.float32(1 / _GAMMA) * 255.0).astype(np.uint8)
