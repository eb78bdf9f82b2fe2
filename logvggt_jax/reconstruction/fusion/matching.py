"""Which frame of a result an external pose belongs to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.exporters.frame_names import file_stems
from logvggt_jax.reconstruction.fusion.pose_files import ExternalPose
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.sources.listing import stem

# What a picture's path may have given to a frame's name, see `FolderSource`; the exports' names have a suffix more.
_FORMS: tuple[Callable[[PurePosixPath], str], ...] = (
    lambda path: "_".join(path.parts),
    lambda path: path.name,
    lambda path: path.stem,
    lambda path: stem(path.name),
)


def match_poses(result: Reconstruction, poses: Sequence[ExternalPose], path: str | Path) -> dict[int, ExternalPose]:
    """Poses by the number of their frame, in the order of the frames.

    Names are compared as they are and as exports write them; time stamps belong to the nearest frame, at most half a
    step away, and of several poses at one frame the nearest counts.

    Raises:
      InputError: no pose belongs to any frame; `path` is where they are from.
    """
    if poses[0].name is not None:
        return _match_names(result, poses, path)
    times, order = result.timestamps, np.argsort(result.timestamps)
    step = float(np.median(np.diff(times[order]))) if len(times) > 1 else 1.0
    given = np.array([pose.timestamp for pose in poses], np.float64)
    nearest: dict[int, ExternalPose] = {}
    for pose, time in zip(poses, given, strict=True):
        index = int(np.abs(times - time).argmin())
        distance = abs(times[index] - time)
        other = nearest.get(index)
        if distance <= step / 2 and (other is None or distance < abs(times[index] - (other.timestamp or 0.0))):
            nearest[index] = pose
    if not nearest:
        raise InputError(
            f"{path}: its times, {given.min():.12g} to {given.max():.12g}, are none of the frames', {times.min():.12g} "
            f"to {times.max():.12g}, to half a step of {step:g}; are they seconds of the same clock?"
        )
    return dict(sorted(nearest.items()))


def _match_names(result: Reconstruction, poses: Sequence[ExternalPose], path: str | Path) -> dict[int, ExternalPose]:
    """By the names of pictures, or what exports call the frames, in the form in which most agree."""
    stems = file_stems(result.names)
    best: dict[int, ExternalPose] = {}
    of_several: list[str] = []
    for form in _FORMS:
        by_name: dict[str, ExternalPose] = {}
        twice = set()
        for pose in poses:
            name = form(PurePosixPath(pose.name or ""))
            if by_name.setdefault(name, pose) is not pose:
                twice.add(name)
        found = {
            index: by_name.get(name, by_name.get(exported))
            for index, (name, exported) in enumerate(zip(result.names, stems, strict=True))
        }
        matched = {index: pose for index, pose in found.items() if pose is not None}
        if len(matched) > len(best):
            best, of_several = matched, sorted(name for name in (*result.names, *stems) if name in twice)
    if of_several:
        raise InputError(
            f"{path}: several of its pictures are named {of_several[0]!r}, as those of several cameras are; keep the "
            "poses of one camera in it"
        )
    if best:
        return best
    raise InputError(
        f"{path}: none of its {len(poses)} pictures ({poses[0].name!r}, …) has the name of one of the "
        f"{result.num_frames} frames ({result.names[0]!r}, …)"
    )
