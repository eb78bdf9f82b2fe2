"""A map rebuilt from better cameras."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from logvggt_jax.data.feeding.transforms import ResizeTransform
from logvggt_jax.errors import InputError
from logvggt_jax.geometry import NoSimilarity, Similarity, camera_centres, pose_similarity, rotation_angle
from logvggt_jax.reconstruction.exporters.libraries import check_library
from logvggt_jax.reconstruction.fusion.bundle_adjustment import bundle_adjust
from logvggt_jax.reconstruction.fusion.depth_scales import depth_scales
from logvggt_jax.reconstruction.fusion.derived_result import check_derived, write_derived
from logvggt_jax.reconstruction.fusion.matching import match_poses
from logvggt_jax.reconstruction.fusion.pose_files import ExternalPose, read_poses
from logvggt_jax.reconstruction.fusion.same_view import is_same_view, lies_on_its_side
from logvggt_jax.reconstruction.fusion.turned import turn_between
from logvggt_jax.reconstruction.result import Reconstruction

# How far the cameras of a result may lie from given ones, as a share of how far these lie from their middle.
_UNLIKE = 0.2


class Fused(NamedTuple):
    """A new result, and what there is to say of how it came about, one line each."""

    result: Reconstruction
    notes: list[str]


class _Cameras(NamedTuple):
    """Cameras [n] for some frames, their intrinsics in pixels of the original images, and the scale of their world."""

    frames: list[int]
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    scale: float


def fuse(
    result: Reconstruction,
    output: str | Path,
    *,
    poses: str | Path | None = None,
    adjust: bool = False,
    metric: bool = False,
    overwrite: bool = False,
    progress: bool = True,
) -> Fused:
    """Makes a result with better cameras: depth is scaled frame by frame to agree with them, points are made anew.

    Args:
      result: the reconstruction, which is only read.
      output: folder of the new result.
      poses: cameras from elsewhere, see `read_poses`; None keeps the result's own. Frames without one are left out.
        Pinhole intrinsics that come with all of them are taken as well.
      adjust: move the cameras by bundle adjustment.
      metric: lengths of the poses are metres.
      overwrite: replace an earlier result.
      progress: show progress bars.

    Raises:
      MissingPackage: pycolmap is needed and not installed.
      OutputExists: something is at `output`.
      InputError: the poses cannot be read, belong to no frame, or do not say how large the world is.
    """
    if poses is None and not adjust:
        raise InputError("nothing to fuse: give poses, bundle adjustment, or both")
    if metric and poses is None:
        raise InputError("metric says what the lengths of poses are: give poses")
    check_derived(result, output, overwrite=overwrite, read=() if poses is None else (poses,))
    if adjust:
        check_library("pycolmap")
    notes: list[str] = []
    if poses is None:
        cameras = _Cameras(list(range(result.num_frames)), result.extrinsics, result.intrinsics, 1.0)
    else:
        cameras = _external(result, poses, notes)
    # In pixels of the depth maps.
    intrinsics = ResizeTransform(result.image_size, result.depth_size).intrinsics_from_original(cameras.intrinsics)
    if adjust:
        scales = np.ones(len(cameras.frames))
        if poses is not None:
            scales = depth_scales(result, cameras.frames, cameras.extrinsics, intrinsics, cameras.scale).scales
        adjusted = bundle_adjust(result, cameras.frames, cameras.extrinsics, intrinsics, scales, progress=progress)
        notes += adjusted.notes()
        cameras = cameras._replace(extrinsics=adjusted.extrinsics)
    scales, *disagreement = depth_scales(result, cameras.frames, cameras.extrinsics, intrinsics, cameras.scale)
    notes.append(_depth_note(scales, *disagreement))
    made = write_derived(
        result,
        output,
        frames=cameras.frames,
        extrinsics=cameras.extrinsics,
        depth_scales=scales,
        intrinsics=cameras.intrinsics,
        metric=metric or (poses is None and result.metric),
        world_is_given=poses is not None or result.world_is_given,
        overwrite=overwrite,
        progress=progress,
    )
    return Fused(made, notes)


def _depth_note(scales: np.ndarray, before: float, after: float) -> str:
    if np.isnan(before):
        return "depth: no two frames see the same, each has the scale of the cameras"
    spread = scales / np.median(scales)
    return (
        f"depth: scaled by {np.median(scales):.4g} ({spread.min():.3f} to {spread.max():.3f} of that); where frames "
        f"see the same they differ by {after:.2%} of it, with one scale by {before:.2%}"
    )


def _in_words(way: tuple[bool, int]) -> str:
    opengl, clockwise = way
    parts = ["OpenGL's axes (y up, z backward)"] if opengl else []
    parts += [f"pictures that have to be turned clockwise by {clockwise} degrees"] if clockwise else []
    return " and ".join(parts)


def align(result: Reconstruction, matched: dict[int, ExternalPose], path: str | Path) -> tuple[Similarity, str]:
    """What moves the result's world to that of some poses, by frame, and how well they then agree, in words.

    Raises InputError, naming the file `path` of the poses, where there is none, or pictures were turned.
    """
    frames, extrinsics = list(matched), np.stack([pose.extrinsics for pose in matched.values()])
    try:
        similarity = pose_similarity(result.extrinsics[frames], extrinsics)
        turn = turn_between(result.extrinsics[frames], extrinsics)
    except NoSimilarity as error:
        raise InputError(f"{path}: {error}") from error
    if turn is not None:
        raise InputError(
            f"{path}: these cameras differ from the frames' by {turn.before:.1f} degrees, and by {turn.after:.1f} if "
            f"theirs are {', or '.join(map(_in_words, turn.ways))}: give cameras with OpenCV's axes, of pictures as "
            "upright as the frames"
        )
    moved = similarity.apply_to_extrinsics(result.extrinsics[frames])
    distances = np.linalg.norm(camera_centres(moved) - camera_centres(extrinsics), axis=1)
    angles = np.degrees(rotation_angle(moved[:, :3, :3], extrinsics[:, :3, :3]))
    said = (
        f"similarity: scale {similarity.scale:.5g}; the result's cameras then lie {np.median(distances):.4g} from the "
        f"poses (median; root mean square {np.sqrt((distances**2).mean()):.4g}), turned by {np.median(angles):.2f} "
        "degrees"
    )
    centres = camera_centres(extrinsics)
    apart = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    if np.median(distances) > _UNLIKE * apart:
        said += (
            f". The poses lie {apart:.4g} from their middle: the two paths are not alike, and the scale is a guess. If "
            "they are of one recording, depth of a sensor or a known distance tells it better (logvggt scale)"
        )
    return similarity, said


def match(result: Reconstruction, poses: str | Path, notes: list[str]) -> dict[int, ExternalPose]:
    """Poses of a file by frame; notes say what belongs to nothing.

    Raises InputError where none does, or one is of a picture that lies on its side.
    """
    given = read_poses(poses)
    matched = match_poses(result, given, poses)
    for index, pose in matched.items():
        if pose.size is not None and lies_on_its_side(result, pose.size):
            (rows, columns), (height, width) = pose.size, result.image_size
            raise InputError(
                f"{poses}: the picture of frame {result.names[index]} has {columns} x {rows} pixels there, and "
                f"{width} x {height} here, where it was turned upright: find the poses in upright pictures, as "
                "`logvggt export --format colmap` writes them"
            )
    if len(matched) < result.num_frames:
        first = next(name for index, name in enumerate(result.names) if index not in matched)
        notes.append(f"{result.num_frames - len(matched)} of {result.num_frames} frames have no pose: {first}, …")
    if len(matched) < len(given):
        notes.append(f"{len(given) - len(matched)} of {len(given)} poses belong to no frame")
    return matched


def _external(result: Reconstruction, path: str | Path, notes: list[str]) -> _Cameras:
    matched = match(result, path, notes)
    if len(matched) < result.num_frames:
        notes.append("frames without a pose are left out")
    similarity, said = align(result, matched, path)
    notes.append(said)
    intrinsics = [_intrinsics(result, pose) for pose in matched.values()]
    usable = [matrix for matrix in intrinsics if matrix is not None]
    frames = list(matched)
    if len(usable) == len(frames):
        notes.append("intrinsics are those of the poses")
        chosen = np.stack(usable)
    else:
        notes.append("intrinsics stay the result's: the poses come without pinholes that fit its pictures")
        chosen = result.intrinsics[frames]
    return _Cameras(frames, np.stack([pose.extrinsics for pose in matched.values()]), chosen, similarity.scale)


def _intrinsics(result: Reconstruction, pose: ExternalPose) -> np.ndarray | None:
    """A pose's intrinsics in pixels of the original images, if its picture shows what they show."""
    if pose.intrinsics is None or pose.size is None or not is_same_view(result, pose.size):
        return None
    return ResizeTransform(pose.size, result.image_size).intrinsics_from_original(pose.intrinsics)
