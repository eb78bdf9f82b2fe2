"""Cameras from other programs: COLMAP models, nerfstudio's transforms.json, TUM trajectories."""

from __future__ import annotations

import warnings
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from logvggt_jax.data.formats.calibration import OPENGL_AXES, check_intrinsics, world_to_camera
from logvggt_jax.data.formats.colmap_model import choose_model, read_cameras, read_images
from logvggt_jax.data.formats.nerfstudio_transforms import CAMERA, TRANSFORMS_FILE, camera_of, lens_of
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.files import read_json, user_path
from logvggt_jax.geometry import LARGEST_ENTRY
from logvggt_jax.reconstruction.exporters.tum import read_trajectory

_EXPECTED = "a COLMAP folder, a transforms.json or its folder, or a trajectory in TUM's format"


class ExternalPose(NamedTuple):
    """A camera that another program has found.

    Attributes:
      name: of its picture, with folders and suffix as the file has them; None where there is a time stamp instead.
      timestamp: seconds; None where there is a name instead.
      extrinsics: [4, 4] float64 world-to-camera, OpenCV axes.
      intrinsics: [3, 3] float64 in pixels of its picture, centres at integers; None where they are unknown or the
        lens is no pinhole.
      size: (H, W) of its picture; None where it is unknown.
    """

    name: str | None
    timestamp: float | None
    extrinsics: np.ndarray
    intrinsics: np.ndarray | None = None
    size: tuple[int, int] | None = None


def read_poses(path: str | Path) -> list[ExternalPose]:
    """The cameras of a COLMAP folder, of a `transforms.json` (or its folder), or of a trajectory in TUM's format.

    Raises:
      MissingInput: nothing is there.
      InputError: it is none of these, damaged, or holds no pose; names file and line or picture.
    """
    path = user_path(path)
    with disk_errors(path):
        if not path.exists():
            raise MissingInput(f"{path} does not exist: expected {_EXPECTED}")
        if path.is_dir():
            if (path / TRANSFORMS_FILE).exists():
                poses = _nerfstudio(path / TRANSFORMS_FILE)
            else:
                poses = _colmap(path)
        elif path.suffix.lower() == ".json":
            poses = _nerfstudio(path)
        else:
            timestamps, extrinsics = read_trajectory(path)
            poses = [ExternalPose(None, float(time), pose) for time, pose in zip(timestamps, extrinsics, strict=True)]
    if not poses:
        raise InputError(f"{path} holds no pose")
    for pose in poses:
        if not (np.abs(pose.extrinsics) < LARGEST_ENTRY).all():
            raise InputError(f"{path}: the pose of {pose.name or pose.timestamp!r} is too large to be one")
        if pose.intrinsics is not None and pose.size is not None:
            check_intrinsics(pose.intrinsics, pose.size, Path(pose.name or ""), path)
    return poses


def _colmap(folder: Path) -> list[ExternalPose]:
    files = SourceFiles()
    chosen = [choose_model(files, each) for each in (folder / "sparse", folder) if each.is_dir()]
    found = [
        (model, said) for model, said in chosen if any((model / f"images.{kind}").exists() for kind in ("bin", "txt"))
    ]
    if not found:
        raise MissingInput(
            f"{folder} holds no poses: expected {TRANSFORMS_FILE}, or COLMAP's images.bin or images.txt, there, in "
            "sparse or in sparse/0"
        )
    model, said = found[0]
    if said:
        warnings.warn(said, stacklevel=2)
    (_, cameras), (file, images) = read_cameras(files, model), read_images(files, model)
    poses = []
    for image in images:
        if image.extrinsics is None:
            continue
        if image.camera not in cameras:
            raise InputError(f"{file}: {image.name!r} has camera {image.camera}, which is not there: export it again")
        camera = cameras[image.camera]
        known = camera.pinhole_and_lens()
        intrinsics = known[0] if known is not None and known[1].is_pinhole else None
        poses.append(ExternalPose(image.name, None, image.extrinsics, intrinsics, camera.size))
    return poses


def _nerfstudio(path: Path) -> list[ExternalPose]:
    document = read_json(path, "so it is no transforms.json of nerfstudio, or damaged")
    try:
        return [_nerfstudio_frame(document, frame, path) for frame in document["frames"]]
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else error
        raise InputError(f"{path} is no transforms.json of nerfstudio, or damaged: {reason}") from error


def _nerfstudio_frame(document: dict[str, Any], frame: dict[str, Any], path: Path) -> ExternalPose:
    name = str(PurePosixPath(frame["file_path"]))
    pose = np.array(frame["transform_matrix"], np.float64)
    if pose.shape not in ((3, 4), (4, 4)) or not (np.abs(pose) < LARGEST_ENTRY).all():
        raise InputError(f"{path}: transform_matrix of {name!r} must be [4, 4] finite numbers, got shape {pose.shape}")
    extrinsics = world_to_camera(pose @ OPENGL_AXES, f"{path}, {name!r}", stored="camera_to_world")
    assert extrinsics is not None  # it is finite
    values = {**document, **frame}
    if any(key not in values for key in CAMERA):
        return ExternalPose(name, None, extrinsics)
    lens, (intrinsics, height, width) = lens_of(values), camera_of(values)
    known = intrinsics if lens is not None and lens.is_pinhole else None
    return ExternalPose(name, None, extrinsics, known, (int(height), int(width)))
