"""`logvggt reconstruct`: a sequence becomes cameras, depth maps and a point cloud."""

from __future__ import annotations

import argparse
import ast
import contextlib
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

from logvggt_jax.cli.choices import FORMATS, METHOD_NAMES
from logvggt_jax.cli.command import (
    add_command,
    calibration_options,
    execution_options,
    loaded_model,
    longer_edge_option,
    output_option,
)
from logvggt_jax.cli.exit_codes import BAD_INPUT
from logvggt_jax.cli.viewing import check_watch, stay_open, watch_options, watched
from logvggt_jax.errors import InputError, one_line, printable
from logvggt_jax.interruption import INTERRUPTED

if TYPE_CHECKING:
    from logvggt_jax.config import ModelConfig
    from logvggt_jax.reconstruction.result import Reconstruction
    from logvggt_jax.reconstruction.sources import Source

SOURCE_OPTIONS = ("stride", "max_frames", "fps", "start", "end", "pattern", "size_mismatch", "strict")


def _reconstruct(options: argparse.Namespace) -> int:
    from logvggt_jax.compile import check_devices, enable_compilation_cache
    from logvggt_jax.files import check_apart
    from logvggt_jax.model.low_precision import check_precision
    from logvggt_jax.reconstruction.calibration import Calibration
    from logvggt_jax.reconstruction.exporters import check_formats
    from logvggt_jax.reconstruction.method import choose_method
    from logvggt_jax.reconstruction.points.point_filter import PointFilter
    from logvggt_jax.reconstruction.reconstruct import LONGER_EDGE, reconstruct
    from logvggt_jax.reconstruction.request import check_method, check_request, describe, what_decides
    from logvggt_jax.reconstruction.sources import open_source
    from logvggt_jax.reconstruction.work_folder import check_leftovers
    from logvggt_jax.weights import resolve
    from logvggt_jax.weights.checkpoints import read_config, read_provenance

    # Before the model: a misspelt path should not have to wait for gigabytes of weights.
    taken = {name: getattr(options, name) for name in SOURCE_OPTIONS}
    source = open_source(options.source, masks=options.masks, **taken)
    point_filter = PointFilter(
        confidence_percentile=options.confidence_percentile,
        edge_threshold=options.edge_threshold or None,
        pixel_stride=options.pixel_stride,
        max_points=options.max_points or None,
    )
    formats = list(dict.fromkeys(options.export))
    check_formats(formats)
    check_watch(options)
    calibration = Calibration(options.intrinsics, options.shared_intrinsics)
    target = check_request(
        source,
        options.output,
        longer_edge=options.longer_edge,
        overwrite=options.overwrite,
        calibration=calibration,
        num_previews=options.previews,
    )
    checkpoint = resolve(options.checkpoint)
    check_apart(target, [checkpoint])
    provenance = read_provenance(checkpoint)
    longer_edge = options.longer_edge or provenance.longer_edge or LONGER_EDGE
    config = read_config(checkpoint, dtype=options.dtype)
    check_devices()
    if options.precision and (note := check_precision(options.precision)):
        source.notes.append(note)
    enable_compilation_cache(options.compilation_cache)
    asked = None if options.method == "auto" else options.method
    if asked is not None:
        _settings(options, asked)  # an error of theirs is told before what is to be expected of the method
    method = choose_method(provenance, asked)
    settings = _settings(options, method)
    check_method(source, method, settings, config, longer_edge)
    decides = what_decides(source, config, method, settings, longer_edge, point_filter, calibration)
    check_leftovers(target, decides, source, overwrite=options.overwrite)
    compiled = config if options.dry_run else None
    needs = describe(source, target, compiled, method, settings, longer_edge, point_filter, formats)
    if provenance.longer_edge not in (None, longer_edge):
        source.notes.append(f"these weights were trained at {provenance.longer_edge} pixels, not {longer_edge}")
    if options.precision and options.dry_run:
        source.notes.append("memory and time are those without --precision")
    said = len(source.notes)
    for note in source.notes:
        print(f"logvggt: note: {printable(note)}", file=sys.stderr)
    for line in needs:
        print(line if options.dry_run else f"logvggt: {line}", file=sys.stdout if options.dry_run else sys.stderr)
    if options.dry_run:
        return 0
    with watched(options) as window:
        with _first_programs(source, config, method, settings, longer_edge, options):
            model, variables = loaded_model(checkpoint, options)
        result = reconstruct(
            source,
            options.output,
            model=model,
            variables=variables,
            method=method,
            settings=settings,
            longer_edge=longer_edge,
            point_filter=point_filter,
            calibration=calibration,
            num_previews=options.previews,
            overwrite=options.overwrite,
            watcher=window,
        )
        for note in source.notes[said:]:  # what only reading told
            print(f"logvggt: note: {printable(note)}", file=sys.stderr)
        print(result.summary())
        code = INTERRUPTED
        if result.complete:
            code = _exports(result, formats)
        elif formats:
            print("logvggt: note: not exported, since it is incomplete; see logvggt export --help", file=sys.stderr)
        stay_open(window, result)
    return code


def _first_programs(
    source: Source, config: ModelConfig, method: str, settings: Any, longer_edge: int, options: argparse.Namespace
) -> AbstractContextManager[None]:
    """Compiles what the run begins with while weights are read, where it is known by then."""
    from logvggt_jax.data.feeding.transforms import resized_size
    from logvggt_jax.model.logvggt import LogVGGT
    from logvggt_jax.streaming import METHODS
    from logvggt_jax.streaming.program import compiled_meanwhile

    if source.image_size is None or source.masks is not None or options.precision:
        return contextlib.nullcontext()
    found, size = METHODS[method], resized_size(source.image_size, longer_edge)
    return compiled_meanwhile(
        lambda: found.opening(LogVGGT(config), size, found.chosen(settings), source.expected_frames)
    )


def _exports(result: Reconstruction, formats: Sequence[str]) -> int:
    """Exports of a result that is finished, each for itself: the result and the others stay, whatever fails."""
    from logvggt_jax.reconstruction.exporters import export

    code = 0
    for name in formats:
        try:
            print(f"{name}: {printable(str(export(result, [name])[0]))}")
        except InputError as error:
            print(f"logvggt: error: the result is whole, its export {name} is not: {one_line(error)}", file=sys.stderr)
            code = BAD_INPUT
    return code


def _settings(options: argparse.Namespace, method: str) -> Any:
    """Settings of the method, of its own class; None for its defaults."""
    from logvggt_jax.config import from_mapping
    from logvggt_jax.streaming import METHODS, ChunkPlan

    if method == "chunks" and not options.setting:
        size = ChunkPlan.size if options.chunk_size is None else options.chunk_size
        overlap = size // 2 if options.chunk_overlap is None else options.chunk_overlap
        return ChunkPlan(size, overlap, options.loops)
    for name, value in {"--chunk-size": options.chunk_size, "--chunk-overlap": options.chunk_overlap}.items():
        if value is not None:
            raise InputError(f"{name} needs --method chunks{' without --setting' if options.setting else ''}")
    if method not in ("chunks", "windows") and options.loops:
        raise InputError(f"--loops needs --method chunks or windows, not {method}")
    given = dict(map(_setting, options.setting or ()))
    if options.loops:
        given["loops"] = True
    return from_mapping(METHODS[method].settings, given, method) if given else None


def _setting(text: str) -> tuple[str, Any]:
    """Name and value of NAME=VALUE: a number, True, False or None where the value reads as one, else its text."""
    name, separator, value = text.partition("=")
    if not separator or not name:
        raise InputError(f"--setting {text}: expected NAME=VALUE, such as cap=4096")
    with contextlib.suppress(ValueError, SyntaxError):
        return name, ast.literal_eval(value)
    return name, value


def add_to(commands: Any) -> None:
    """Adds the command."""
    sub = add_command(
        commands,
        "reconstruct",
        _reconstruct,
        "cameras, depth maps and a coloured point cloud from a folder of images or a video",
        "logvggt reconstruct walk.mp4 --stride 3 --checkpoint models/log-vggt --output runs/walk",
        details=" The work lies in OUTPUT.partial until it is done; a run that ended early, for whatever reason, is "
        "taken up by the same command. Ctrl-C ends the sequence at the window at hand and leaves a valid result of the "
        "frames so far; a second one stops at once.",
    )
    sub.add_argument(
        "source",
        help="folder of images (natural order; 7-Scenes: its colour images), a pattern in quotes ('walk/*.jpg'), a "
        "text file that lists images, a video, a camera's number, or the address of a stream",
    )
    sub.add_argument(
        "--checkpoint",
        required=True,
        metavar="PATH_OR_REPO",
        help="`rooms`, the small model that ships; or a model folder, folder of a training run, VGGT checkpoint (a "
        "file, or its folder), or hub repository, hf:OWNER/NAME[/FILE] or OWNER/NAME where no folder OWNER is here",
    )
    output_option(sub)
    longer_edge_option(sub)
    frames = sub.add_argument_group("frames")
    frames.add_argument("--stride", type=int, default=1, metavar="N", help="take every N-th frame")
    frames.add_argument("--max-frames", type=int, default=None, metavar="N", help="stop after N frames")
    frames.add_argument("--fps", type=float, default=None, metavar="N", help="take at most N frames a second")
    frames.add_argument("--start", type=float, default=None, metavar="SECONDS", help="leave out what comes before")
    frames.add_argument("--end", type=float, default=None, metavar="SECONDS", help="leave out what comes after")
    frames.add_argument("--pattern", default=None, metavar="GLOB", help="take image files with such names alone")
    frames.add_argument(
        "--size-mismatch",
        choices=("error", "crop", "skip"),
        default="error",
        help="images of several sizes: refuse them, crop all to what they share, or leave out the rarer sizes",
    )
    frames.add_argument(
        "--strict", action="store_true", help="stop at a frame that cannot be read instead of leaving it out"
    )
    frames.add_argument(
        "--masks",
        default=None,
        metavar="PATH",
        help="folder with a mask for each frame, NAME.png or NAME.jpg.png (for a video its position, from 0: "
        "000123.png), or one picture for all frames (a car's bonnet, dirt on the lens). What is black or transparent "
        "is left out (no influence, no depth, no points), all else counts, as COLMAP has it. With --method windows, "
        "chunks and offline",
    )
    execution_options(sub)
    sub.add_argument(
        "--method",
        "--mode",
        dest="method",
        choices=("auto", *METHOD_NAMES),
        default="auto",
        help="windows: LoG-VGGT's stream. chunks: plain VGGT on overlapping chunks chained by similarities, for public "
        "VGGT weights, which never learned the relay from window to window. offline: plain VGGT on all frames at once, "
        "where they fit the memory. merged: the same with merged tokens (FastVGGT). causal (StreamVGGT), "
        "anchored-window (STream3R), rolling (InfiniteVGGT), pruned (XStreamVGGT): frame by frame with a cache of all "
        "earlier frames, of the first and the newest, within a budget, or of what the newest frame looks for. auto: "
        "what the weights were trained for",
    )
    sub.add_argument(
        "--chunk-size",
        type=int,
        default=None,
        metavar="N",
        help="frames of a chunk, as many as memory allows (default: 60)",
    )
    sub.add_argument(
        "--chunk-overlap", type=int, default=None, metavar="N", help="frames that neighbours share (default: half)"
    )
    sub.add_argument(
        "--setting",
        action="append",
        metavar="NAME=VALUE",
        help="a setting of the method, may be given several times: budget=600000 of rolling, cap=4096 or bits=16 of "
        "pruned, window=8 of anchored-window, camera_cache=single of causal, rolling and pruned; see docs/methods.md",
    )
    sub.add_argument(
        "--loops",
        action="store_true",
        help="with chunks or windows: close loops when the sequence ends, where the camera comes back to a place after "
        "60 frames or more. Both places are predicted together, and a loop is refused where that does not fit. Up to "
        "512 frames are kept in memory",
    )
    calibration_options(sub)
    points = sub.add_argument_group("point cloud")
    points.add_argument(
        "--confidence-percentile",
        type=float,
        default=25.0,
        metavar="PERCENT",
        help="leave out this share of pixels, the least confident",
    )
    points.add_argument(
        "--edge-threshold",
        type=float,
        default=0.1,
        metavar="FRACTION",
        help="leave out pixels at relative depth steps above this; 0 keeps all",
    )
    points.add_argument("--pixel-stride", type=int, default=1, metavar="N", help="take every N-th pixel and row")
    points.add_argument(
        "--max-points", type=int, default=2_000_000, metavar="N", help="thin the cloud to N points; 0 keeps all"
    )
    sub.add_argument("--previews", type=int, default=8, metavar="N", help="pictures of frames beside their depth")
    sub.add_argument(
        "--export",
        action="append",
        default=[],
        choices=FORMATS,
        metavar="FORMAT",
        help="write the finished result in this format too, into OUTPUT/exports; may be given several times "
        "(`logvggt export --help` lists the formats)",
    )
    watch_options(sub)
    sub.add_argument(
        "--overwrite", action="store_true", help="begin anew and replace an earlier or unfinished reconstruction"
    )
    sub.add_argument(
        "--dry-run",
        action="store_true",
        help="check everything that can be checked before the weights are read, compile the program, and print frames, "
        "size, memory and time",
    )
