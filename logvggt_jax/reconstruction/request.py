"""What can be checked before a model is loaded: output, free space, size; and what a run will need."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from logvggt_jax.config import ModelConfig
from logvggt_jax.data.feeding.transforms import check_longer_edge, resized_size
from logvggt_jax.errors import InputError
from logvggt_jax.files import check_apart, check_output, check_space, check_writable, user_path
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.operations import matmul_flops_per_second
from logvggt_jax.reconstruction.calibration import Calibration
from logvggt_jax.reconstruction.exporters import check_exports, frame_bytes
from logvggt_jax.reconstruction.points.cloud_file import VERTEX
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result_folder import RESULT
from logvggt_jax.reconstruction.sources import Source
from logvggt_jax.reconstruction.work_folder import is_unfinished
from logvggt_jax.streaming import METHODS
from logvggt_jax.streaming.program import abstract_variables

# Of a photograph at the quality that images are kept at, measured on 7-Scenes and procedural rooms; noise takes more.
_JPEG_BYTES_PER_PIXEL = 1.0
# Depth and confidence, float16.
_DEPTH_BYTES_PER_PIXEL = 4.0
# Of the rate of large matrix products; an H100 reaches half, see the README.
_REACHED = 1 / 3


def check_request(
    source: Source,
    output: str | Path,
    *,
    longer_edge: int | None,
    overwrite: bool,
    calibration: Calibration | None = None,
    num_previews: int = 0,
) -> Path:
    """The absolute path of the output, if `reconstruct` can begin; for callers that want to know before they load a
    large model. Arguments and errors as in `reconstruct`.
    """
    if longer_edge is not None:
        check_longer_edge(longer_edge)
    if num_previews < 0:
        raise InputError(f"previews must not be negative, got {num_previews}")
    if calibration is not None and calibration.pinhole is not None and source.is_cut:
        raise InputError(
            f"intrinsics are those of whole images, of which {source.name} gives parts: take --size-mismatch skip, or "
            "cut the images beforehand"
        )
    if calibration is not None and source.image_size is not None:
        calibration.check(source.image_size)
    target = user_path(output, resolved=True)
    if target in (source.path.resolve(), *source.path.resolve().parents):
        raise InputError(f"output {output} contains the source {source.path}: choose another output")
    if overwrite or not is_unfinished(target):
        check_output(target, overwrite=overwrite, kind=RESULT)
        check_exports(target)
    check_apart(target, source.files())
    check_writable(target)
    return target


def what_decides(
    source: Source,
    config: ModelConfig,
    method: str,
    settings: Any,
    longer_edge: int,
    point_filter: PointFilter,
    calibration: Calibration,
) -> dict[str, str]:
    """What decides a result beside frames and weights; a run can be taken up by another that has the same."""
    return {
        "version": importlib.metadata.version("logvggt-jax"),
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "model": str(config),
        "method": method,
        "settings": str(settings),
        "longer_edge": str(longer_edge),
        "point_filter": str(point_filter),
        "calibration": str(calibration),
        # Left out where there are none, as by earlier versions, whose runs can be taken up.
        **({} if source.masks is None else {"masks": str(source.masks.path.resolve())}),
    }


def check_method(source: Source, method: str, settings: Any, config: ModelConfig, longer_edge: int) -> None:
    """Raises InputError where the method cannot take the source: it has masks and the method takes none, or its frames
    at the model's size are larger than all that the method may keep."""
    found = METHODS[method]
    if source.masks is not None and not found.takes_masks:
        able = ", ".join(name for name, each in METHODS.items() if each.takes_masks)
        raise InputError(f"--method {method} takes no masks: choose one of {able}, or leave --masks out")
    if source.image_size is not None:  # else it is known with the first frame
        found.check(config, resized_size(source.image_size, longer_edge), found.chosen(settings))


def disk_bytes(num_frames: int | None, size: tuple[int, int], point_filter: PointFilter) -> tuple[int, int]:
    """Bytes that a result of frames of `size` (h, w) needs on the disk: a frame, and in all (None: of one frame)."""
    height, width = size
    frame = int(height * width * (_JPEG_BYTES_PER_PIXEL + _DEPTH_BYTES_PER_PIXEL))
    frames = num_frames or 1
    pixels = frames * height * width // point_filter.pixel_stride**2
    points = min(pixels, point_filter.max_points or pixels) * VERTEX.itemsize
    return frame, frames * frame + points


@dataclasses.dataclass(frozen=True)
class DeviceNeeds:
    """What a method's program needs on the device at hand.

    Attributes:
      parameters: bytes.
      working: bytes of everything else while it runs, by the compiler's account; None where it does not say.
      seconds_a_frame: an estimate, as if a third of the rate of a large matrix product were reached.
    """

    parameters: int
    working: int | None
    seconds_a_frame: float


def describe(
    source: Source,
    output: Path,
    config: ModelConfig | None,
    method: str,
    settings: Any,
    longer_edge: int,
    point_filter: PointFilter,
    formats: Sequence[str] = (),
) -> list[str]:
    """Frames, size and disk of a run and the exports of its result in a few lines; with the model's sizes also memory
    and time on the device at hand.

    Raises:
      InputError: the disk is too small.
    """
    frames = source.expected_frames
    count = "an unknown number of" if frames is None else f"{frames:,}"
    if source.image_size is None:
        return [f"{count} frames of a size that is known with the first one; method {method}"]
    size = resized_size(source.image_size, longer_edge)
    frame, whole = disk_bytes(frames, size, point_filter)
    exported = frame_bytes(formats, source.image_size, source.image_size)
    frame, whole = frame + exported, whole + (frames or 1) * exported
    fewer = " or fewer formats (--export)" if exported else ""
    mend = f"make room, choose another output, or take fewer (--stride) or smaller frames{fewer}"
    space = check_space(output, whole, mend)
    a_frame = "" if frames is not None else f"; {frame / 1e6:.2f} MB a frame"
    original = "x".join(map(str, source.image_size[::-1]))
    lines = [
        f"{count} frames of {original} pixels, {size[1]}x{size[0]} for the model; method {method}",
        f"disk: {space}{a_frame}",
    ]
    if config is not None:
        needs = device_needs(method, LogVGGT(config), settings, size, frames)
        kept = "" if needs.working is None else f", {needs.working / 1e9:.2f} GB to work with"
        lines.append(f"device ({jax.devices()[0].device_kind}): {needs.parameters / 1e9:.2f} GB of parameters{kept}")
        seconds = needs.seconds_a_frame
        lines.append(
            f"time: about {seconds:.2g} s a frame"
            + ("" if frames is None else f", {frames * seconds / 60:.1f} minutes in all")
            + ", as if the device reached a third of its rate for matrix products; compilation comes first"
        )
    return lines


def device_needs(
    method: str, model: LogVGGT, settings: Any, size: tuple[int, int], num_frames: int | None
) -> DeviceNeeds:
    """Compiles the method's program for images of `size` (h, w); the compilation cache keeps it for the run itself."""
    found = METHODS[method]
    program = found.program(model, size, found.chosen(settings), num_frames)
    parameters = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(abstract_variables(model.config)))
    memory: Any = program.lowered.compile().memory_analysis()
    working = None
    if memory is not None:
        # Parameters that the program does not read are no arguments of what is compiled, and are on the device as well.
        given = sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(program.lowered.args_info))
        working = given + memory.output_size_in_bytes + memory.temp_size_in_bytes
        working -= memory.alias_size_in_bytes + parameters
    rate = _REACHED * matmul_flops_per_second(model.config.dtype)
    return DeviceNeeds(parameters, working, program.flops / program.frames / rate)
