"""A result whose cameras, depth or unit differ from those of the one it is made from."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from logvggt_jax.data.feeding.transforms import ResizeTransform
from logvggt_jax.errors import InputError, disk_errors
from logvggt_jax.files import atomic_folder, check_apart, check_output, check_writable
from logvggt_jax.reconstruction.cameras_file import CAMERAS_FILE, write_cameras
from logvggt_jax.reconstruction.depth_files import (
    DEPTH_FOLDER,
    IMAGE_FOLDER,
    ORIGINAL_FOLDER,
    check_range,
    depth_file,
    image_file,
    original_file,
    write_depth,
)
from logvggt_jax.reconstruction.exporters import check_exports
from logvggt_jax.reconstruction.exporters.ply import export_ply
from logvggt_jax.reconstruction.exporters.tum import export_tum
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.health.recorder import HealthRecorder
from logvggt_jax.reconstruction.health.report import HEALTH_FILE, HEALTH_PAGE, examine, without_harm, write_health
from logvggt_jax.reconstruction.previews import write_previews
from logvggt_jax.reconstruction.result import Reconstruction, preview_file
from logvggt_jax.reconstruction.result_folder import POINTS_FILE, RESULT, TRAJECTORY_FILE
from logvggt_jax.streaming import Signals


def check_derived(
    result: Reconstruction, output: str | Path, *, overwrite: bool, read: Sequence[str | Path] = ()
) -> Path:
    """The absolute path for a result that is made from another, and from what else is `read`; OutputExists or
    InputError if it cannot go there."""
    target = check_output(output, overwrite=overwrite, kind=RESULT)
    check_exports(target)
    source = result.folder.resolve()
    if target == source or source in target.parents or target in source.parents:
        raise InputError(f"{target} is the result itself, or one lies in the other: choose another output")
    check_apart(target, read)
    check_writable(target)
    return target


def write_derived(
    result: Reconstruction,
    output: str | Path,
    *,
    frames: Sequence[int],
    extrinsics: np.ndarray,
    depth_scales: np.ndarray,
    intrinsics: np.ndarray,
    metric: bool,
    world_is_given: bool,
    keeps_health: bool = False,
    overwrite: bool = False,
    progress: bool = True,
) -> Reconstruction:
    """Writes a result with other cameras: depth is scaled, points are made anew, images stay.

    Args:
      result: the result that it is made from, which is only read.
      output: folder to make; it appears when all is done.
      frames: [n] numbers of the frames that it has.
      extrinsics: [n, 3|4, 4] world-to-camera.
      depth_scales: [n], by which the depth is multiplied.
      intrinsics: [n, 3, 3] in pixels of the original images.
      metric: whether lengths are metres.
      world_is_given: whether the cameras are those of poses from elsewhere.
      keeps_health: whether its report on the result's health, of which no measure has a unit, holds as it is; else one
        is made of the new cameras and depth, and of what the earlier one knows of the stream.
      overwrite: replace an earlier result.
      progress: show a progress bar.

    Raises:
      OutputExists: something is at `output`.
      InputError: a file of the result is damaged, or depth is too large or too small for a file.
    """
    target = check_derived(result, output, overwrite=overwrite)
    transform = ResizeTransform(result.image_size, result.depth_size)
    names = [result.names[index] for index in frames]
    recorder = HealthRecorder()
    with atomic_folder(target, replace=overwrite) as folder, disk_errors(target), FramePool() as pool:
        keeps_originals = (result.folder / ORIGINAL_FOLDER).is_dir()
        for name in (DEPTH_FOLDER, IMAGE_FOLDER, *([ORIGINAL_FOLDER] if keeps_originals else [])):
            (folder / name).mkdir()

        def write(place: int) -> None:
            depth, confidence = result.depth_and_confidence(frames[place])
            scaled = depth_scales[place] * depth
            check_range(scaled, names[place])
            stored = write_depth(depth_file(folder, names[place]), scaled, confidence)
            if not keeps_health:
                with without_harm():
                    recorder.see(place, *stored, result.image(frames[place]))
            shutil.copyfile(image_file(result.folder, names[place]), image_file(folder, names[place]))
            if keeps_originals:
                shutil.copyfile(original_file(result.folder, names[place]), original_file(folder, names[place]))

        for _ in pool.map(write, iter(range(len(frames)))):
            pass
        write_cameras(
            folder / CAMERAS_FILE,
            names=names,
            timestamps=result.timestamps[list(frames)].tolist(),
            extrinsics=np.asarray(extrinsics)[:, :3],
            intrinsics=intrinsics,
            image_size=result.image_size,
            model_intrinsics=transform.intrinsics_from_original(intrinsics),
            model_size=result.depth_size,
            complete=result.complete,
            noted_focal_length=result.noted_focal_length,
            skipped=[(name, "left out of the result that this one is made from") for name in result.skipped],
            source=result.source,
            metric=metric,
            world_is_given=world_is_given,
            loops=_kept_loops(result, frames),
            masked=result.masked[list(frames)].tolist() if result.masked.any() else None,
            timed=result.timed,
            point_filter=result.point_filter,
        )
        made = Reconstruction.with_cameras_of(folder)
        # Of the same frames: depths have changed, and so has what their scale says.
        before = [preview_file(result.folder, name) for name in names]
        write_previews(made, [place for place, file in enumerate(before) if file.is_file()], pool)
        if keeps_health:
            for name in (HEALTH_FILE, HEALTH_PAGE):
                if (result.folder / name).is_file():
                    shutil.copyfile(result.folder / name, folder / name)
        else:
            _write_health(made, recorder, result, frames)
        pool.finish()
        export_tum(made, folder / TRAJECTORY_FILE)
        export_ply(made, folder / POINTS_FILE, progress=progress)
    return Reconstruction.open(target)


def _write_health(
    made: Reconstruction, recorder: HealthRecorder, result: Reconstruction, frames: Sequence[int]
) -> None:
    """Writes what is to be said of `made`, which has some frames of `result`; never raises."""
    with without_harm():
        signals = Signals.unknown(len(frames))
        if (before := result.health) is not None:
            known = before.measures.arrays()
            signals = Signals(*(known[name][list(frames)] for name in Signals._fields))
        focal = made.depth_intrinsics[:, 0, 0]
        measures = recorder.measures(
            size=made.depth_size,
            extrinsics=made.extrinsics,
            intrinsics=made.depth_intrinsics,
            depth_scale=made.depth_scale,
            field_of_view=2 * np.arctan(made.depth_size[1] / 2 / focal),
            signals=signals,
        )
        write_health(made.folder, examine(measures, made.names), made.names)


def _kept_loops(result: Reconstruction, frames: Sequence[int]) -> np.ndarray | None:
    """The loops of a result by their places among some of its frames, those of which both ends are there."""
    if result.loops is None:
        return None
    places = {frame: place for place, frame in enumerate(frames)}
    kept = [(places[a], places[b]) for a, b in result.loops if a in places and b in places]
    return np.array(kept, np.int64).reshape(-1, 2)
