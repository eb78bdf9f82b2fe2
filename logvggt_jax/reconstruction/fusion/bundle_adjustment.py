"""Cameras that agree with what the images show, by pycolmap's bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.geometry import NoSimilarity, camera_centres, pose_similarity, rotation_angle
from logvggt_jax.reconstruction.exporters.colmap import build_model
from logvggt_jax.reconstruction.exporters.libraries import library
from logvggt_jax.reconstruction.fusion.image_tracks import follow_corners
from logvggt_jax.reconstruction.result import Reconstruction

# Pixels beyond which an observation's influence stops growing.
_ROBUST = 0.5
_FEWEST_OBSERVATIONS = 15
# Changes between neighbours that no better camera has: the turn's in degrees, the way's as a share of the path's size.
_BROKEN_TURN, _BROKEN_SHIFT = 10.0, 0.5


class Adjusted(NamedTuple):
    """What bundle adjustment found.

    Attributes:
      extrinsics: [n, 4, 4] float64 world-to-camera, in the world of the cameras before.
      num_points: corners that were followed.
      before, after: median over the corners of their mean distance from where they project to, in pixels of the depth
        maps.
      num_loose: frames that showed too little to move.
      turned: the largest change of the rotation between neighbours, in degrees.
      shifted: the largest change of the way between neighbours, over the median distance of the cameras from their
        middle.
    """

    extrinsics: np.ndarray
    num_points: int
    before: float
    after: float
    num_loose: int
    turned: float
    shifted: float

    def notes(self) -> list[str]:
        """What to say of it, one line each."""
        said = [
            f"bundle adjustment: {self.num_points} corners lie {self.after:.2f} pixels from where they project to, "
            f"before {self.before:.2f}"
        ]
        if self.num_loose:
            said.append(f"{self.num_loose} frames show too little to be moved")
        return [*said, f"between neighbours {self.steps}"]

    @property
    def steps(self) -> str:
        """The largest changes between neighbours, in words."""
        return (
            f"cameras turn by up to {self.turned:.2f} degrees more or less than before, and go up to "
            f"{self.shifted:.1%} of the path's size further or less far"
        )


def bundle_adjust(
    result: Reconstruction,
    frames: Sequence[int],
    extrinsics: np.ndarray,
    intrinsics: np.ndarray,
    scales: np.ndarray,
    *,
    progress: bool = True,
) -> Adjusted:
    """Moves cameras until corners of the images, which depth helps to find again, lie where they project to.

    Intrinsics stay: corners of a sequence tell a focal length less well than the model does. Place and scale of the
    world, which images do not tell, stay the cameras' as they were.

    Args:
      result: of images and depth.
      frames: [n] numbers of the frames.
      extrinsics: [n, 3|4, 4] world-to-camera.
      intrinsics: [n, 3, 3] in pixels of the depth maps.
      scales: [n] of the depth.
      progress: show a progress bar.

    Raises:
      MissingPackage: pycolmap is not installed.
      InputError: the images show too little that could be found again, or the cameras do not stay near one another.
    """
    pycolmap = library("pycolmap")
    size, extrinsics = result.depth_size, np.asarray(extrinsics)[:, :3]
    tracks = follow_corners(result, frames, extrinsics, intrinsics, scales, progress=progress)
    observed = np.bincount(tracks.frames, minlength=len(frames))
    tied = observed >= _FEWEST_OBSERVATIONS
    if tied.sum() < 2:
        raise InputError(
            f"bundle adjustment found {len(tracks.points)} corners again in the images of {result.folder}, too few to "
            "move a camera: there is too little texture, or the frames share too little"
        )
    names = [str(index) for index in range(len(frames))]
    model = build_model(pycolmap, extrinsics, intrinsics, size, names, tracks, size)
    before = _median_error(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _ROBUST
    config = pycolmap.BundleAdjustmentConfig()
    for index in range(len(frames)):
        config.add_image(index + 1)
        if not tied[index]:
            config.set_constant_rig_from_world_pose(index + 1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    solved = np.stack([model.image(index + 1).cam_from_world().matrix() for index in range(len(frames))])
    try:
        moved = pose_similarity(solved[tied], extrinsics[tied]).apply_to_extrinsics(solved)
    except NoSimilarity as error:
        raise InputError(
            f"bundle adjustment of {result.folder} did not hold ({error}): leave it out, or give better cameras to "
            "begin with"
        ) from error
    steps = _largest_steps(extrinsics, moved)
    adjusted = Adjusted(moved, len(tracks.points), before, _median_error(model), int((~tied).sum()), *steps)
    if adjusted.turned > _BROKEN_TURN or adjusted.shifted > _BROKEN_SHIFT:
        raise InputError(
            f"bundle adjustment of {result.folder} did not hold: {len(tracks.points)} corners lie well, but "
            f"{adjusted.steps}; leave it out, or give better cameras to begin with"
        )
    return adjusted


def _largest_steps(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """By how much the motion between two neighbours has changed at most, see `Adjusted`."""
    old, new = (cameras[:, :3, :3] for cameras in (before, after))
    turned = rotation_angle(old[1:] @ np.swapaxes(old[:-1], -1, -2), new[1:] @ np.swapaxes(new[:-1], -1, -2))
    ways = [np.linalg.norm(np.diff(camera_centres(cameras), axis=0), axis=1) for cameras in (before, after)]
    centres = camera_centres(before)
    size = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    return float(np.degrees(turned).max()), float(np.abs(ways[1] - ways[0]).max()) / max(size, np.finfo(float).tiny)


def _median_error(model: object) -> float:
    model.update_point_3d_errors()  # type: ignore[attr-defined]
    return float(np.median([point.error for point in model.points3D.values()]))  # type: ignore[attr-defined]
