"""From a folder of images or a video to cameras, depth maps and a coloured point cloud on disk."""

from __future__ import annotations

import dataclasses
import time
import warnings
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from logvggt_jax.data.feeding.transforms import LONGER_EDGE
from logvggt_jax.interruption import StopRequest
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.model.low_precision import precision_of
from logvggt_jax.reconstruction.calibration import Calibration
from logvggt_jax.reconstruction.cameras_file import CAMERAS_FILE
from logvggt_jax.reconstruction.finishing import finish
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.points.selection import PointSelection
from logvggt_jax.reconstruction.request import check_method, check_request, what_decides
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.run import Run
from logvggt_jax.reconstruction.sources import Source, open_source
from logvggt_jax.reconstruction.watching import Watcher
from logvggt_jax.reconstruction.work_folder import WorkFolder
from logvggt_jax.streaming import open_predictor
from logvggt_jax.weights.digests import digests, json_digest


def reconstruct(
    source: Source | str | Path,
    output: str | Path,
    *,
    model: LogVGGT,
    variables: Variables,
    method: str = "windows",
    settings: Any = None,
    longer_edge: int = LONGER_EDGE,
    point_filter: PointFilter | None = None,
    calibration: Calibration | None = None,
    num_previews: int = 8,
    overwrite: bool = False,
    progress: bool = True,
    workers: int | None = None,
    save_seconds: float = 1.0,
    watcher: Watcher | None = None,
) -> Reconstruction:
    """Reconstructs a sequence and writes cameras, trajectory, depth and points.

    Frames are read once, ahead of the model, and kept at its size; depth maps are written as they become final. All
    that is not the model is done by worker threads, whose number changes no result. Memory on the host is constant
    but for the cameras and at most 104 MB of candidates for the point cloud, memory on the device is the method's.

    The work lies in `<output>.partial` until all is done. A run that ends before, for whatever reason, is taken up by
    the next one that is asked for the same, and gives the same bytes. In the main thread the first Ctrl-C ends the
    sequence at the window at hand: a valid result of the frames so far, marked incomplete, which can still be taken
    up. SIGTERM and SIGHUP save and end.

    Args:
      source: folder of images or video; what `open_source` gives chooses among the frames, and has their masks.
      output: folder to make; it appears when all is done.
      model: the model.
      variables: {"params": …}, perhaps in eight bits (`in_low_precision`).
      method: name of `logvggt_jax.streaming.METHODS`; `chunks` for public VGGT weights, see `choose_method`.
      settings: of the method's own settings class; None for its defaults.
      longer_edge: size in pixels, a multiple of 14, to which the longer edge of the frames is resized; take
        what the model was trained with (518 for VGGT).
      point_filter: which pixels become points.
      calibration: intrinsics that are known; None takes those that the model predicts, frame by frame.
      num_previews: pictures of frames beside their depth, evenly over the sequence.
      overwrite: begin anew, whatever an earlier run has left, and replace an earlier reconstruction.
      progress: show a progress bar where standard error is a terminal, and say there if a run is taken up.
      workers: threads beside the one that feeds the device; None for one a core, at most eight.
      save_seconds: time between two saved states; longer where saving takes more than a twentieth of the time.
      watcher: is shown every frame whose depth is final, and poses as they are known; changes no result.

    Raises:
      OutputExists: `output` exists, or an unfinished result that was asked for otherwise lies beside it.
      InputError: bad source or parameters, or a sequence that the method cannot predict.
      Interrupted: a signal ended the run before anything was final, or asked it to save and end.
    """
    source = source if isinstance(source, Source) else open_source(source)
    calibration, point_filter = calibration or Calibration(), point_filter or PointFilter()
    target = check_request(
        source,
        output,
        longer_edge=longer_edge,
        overwrite=overwrite,
        calibration=calibration,
        num_previews=num_previews,
    )
    check_method(source, method, settings, model.config, longer_edge)
    request = {
        **what_decides(source, model.config, method, settings, longer_edge, point_filter, calibration),
        "weights": json_digest(digests(variables)),
        **({} if (precision := precision_of(variables)) is None else {"precision": precision}),
    }
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    console = Console(stderr=True)
    bars = Progress(*columns, console=console, disable=not (progress and console.is_terminal))
    with (
        WorkFolder(target, request, overwrite=overwrite) as work,
        StopRequest("SIGINT", "SIGTERM", "SIGHUP") as stop,
        FramePool(workers) as pool,
        bars,
    ):
        run = Run(
            source=source,
            work=work,
            predictor=open_predictor(method, model, variables, settings),
            pool=pool,
            selection=PointSelection(point_filter, source.expected_frames),
            longer_edge=longer_edge,
            save_seconds=save_seconds,
            watcher=watcher,
        )
        task = bars.add_task("Depth and cameras", total=source.expected_frames, completed=run.num_taken)
        if run.num_taken and progress:
            console.print(f"going on after {run.num_taken} frames that an earlier run has done", highlight=False)
        started = time.monotonic()
        complete = run.stream(
            stop,
            advance=lambda: bars.advance(task),
            refined=lambda done, count: bars.update(task, description="Refinement", completed=done, total=count),
        )
        seconds = time.monotonic() - started
        run.write_cameras(calibration, complete=complete)
        result = Reconstruction.with_cameras_of(work.path)
        run.write_health(result)
        bars.reset(task, description="Points", total=result.num_frames)
        finish(result, run.selection, pool, num_previews=num_previews, advance=lambda: bars.advance(task))
        work.commit(complete=complete)
    if source.skipped:
        warnings.warn(
            f"{len(source.skipped)} frames could not be read and are left out, see {CAMERAS_FILE}: "
            f"{source.skipped[0].name} ({source.skipped[0].reason})",
            stacklevel=2,
        )
    return dataclasses.replace(result, folder=target, seconds=seconds)


class _Rate(ProgressColumn):
    """Frames a second."""

    def render(self, task: Task) -> Text:
        # Rich forgets the speed when the total is corrected, as it is at the end of a video.
        speed = task.finished_speed or task.speed or (task.completed / task.elapsed if task.elapsed else 0.0)
        return Text(f"{speed:.2f} frames/s")
