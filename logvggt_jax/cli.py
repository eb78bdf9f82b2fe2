"""The `logvggt` command: convert weights, reconstruct sequences, follow cameras, check data, look at results."""

# Commands import what they need when they run: JAX takes seconds to load, `--help` should not.

from __future__ import annotations

import argparse
import ast
import contextlib
import json
import shutil
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from logvggt_jax.errors import InputError, disk_errors, one_line, printable
from logvggt_jax.interruption import Interrupted
from logvggt_jax.terminal import forgiving_streams

if TYPE_CHECKING:
    from logvggt_jax.reconstruction.fusion.fuse import Fused
    from logvggt_jax.reconstruction.result import Reconstruction

OUTPUT_LOST, BAD_INPUT, INTERRUPTED = 1, 2, 130
SOURCE_OPTIONS = ("stride", "max_frames", "fps", "start", "end", "pattern", "size_mismatch", "strict")
# The registry of methods, which would load JAX.
MODES = ("windows", "chunks", "offline", "merged", "causal", "anchored-window", "rolling", "pruned")
FORMATS = (
    *("colmap", "colmap-text", "nerfstudio", "glb", "ply", "tum", "kitti", "euroc"),
    *("depth-png", "depth-exr", "depth-npz", "rosbag2"),
)
PROBLEMS_FOUND = 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns the exit code.

    0; 2 for bad input; 128 and its number where a signal ended the run; 1 where `data check` or `doctor` found
    problems, or standard output could not be written. A reader of standard output that goes away is no error. Any
    exception but InputError is a fault of this package and passes through with its traceback.

    Args:
      arguments: without the program's name; default `sys.argv[1:]`.
    """
    with forgiving_streams() as output:
        code = _run(sys.argv[1:] if arguments is None else arguments)
    if output.failure is not None and not isinstance(output.failure, BrokenPipeError):
        print(f"logvggt: error: standard output cannot be written: {one_line(output.failure)}", file=sys.stderr)
        return code or OUTPUT_LOST
    return code


def _run(arguments: Sequence[str]) -> int:
    options = _parser().parse_args(_with_dashes(arguments))
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            return options.run(options) or 0
    except KeyboardInterrupt:
        print("logvggt: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Interrupted as interruption:
        print(f"logvggt: ended by {interruption.signal}: {interruption}", file=sys.stderr)
        return 128 + signal.Signals[interruption.signal]
    except InputError as error:
        if options.traceback:
            traceback.print_exc()
        print(f"logvggt: error: {one_line(error)}", file=sys.stderr)
        return BAD_INPUT


def _convert(options: argparse.Namespace) -> None:
    from logvggt_jax.compile import check_devices
    from logvggt_jax.weights.checkpoints import convert

    check_devices()
    report = convert(
        options.source,
        options.output,
        point_head=options.point_head,
        overwrite=options.overwrite,
        trained_for=options.trained_for,
    )
    if options.keys:
        for name in report.used:
            print(f"  used: {name} -> {', '.join(report.targets[name])}")
    for title, names in (("skipped", report.skipped), ("initialised", report.initialised)):
        for name in names:
            print(f"  {title}: {name}")
    print(f"model: {options.output}")


def _reconstruct(options: argparse.Namespace) -> int:
    from logvggt_jax.compile import check_devices, enable_compilation_cache
    from logvggt_jax.model.parameters import in_compute_type
    from logvggt_jax.reconstruction.calibration import Calibration
    from logvggt_jax.reconstruction.exporters import check_formats
    from logvggt_jax.reconstruction.method import choose_method
    from logvggt_jax.reconstruction.point_cloud import PointFilter
    from logvggt_jax.reconstruction.reconstruct import LONGER_EDGE, reconstruct
    from logvggt_jax.reconstruction.request import check_request, describe
    from logvggt_jax.reconstruction.sources import open_source
    from logvggt_jax.weights import resolve
    from logvggt_jax.weights.checkpoints import from_pretrained, read_config, read_provenance

    # Before the model: a misspelt path should not have to wait for gigabytes of weights.
    source = open_source(options.source, **{name: getattr(options, name) for name in SOURCE_OPTIONS})
    point_filter = PointFilter(
        confidence_percentile=options.confidence_percentile,
        edge_threshold=options.edge_threshold or None,
        pixel_stride=options.pixel_stride,
        max_points=options.max_points or None,
    )
    check_formats(options.export)
    calibration = Calibration(options.intrinsics, options.shared_intrinsics)
    target = check_request(
        source,
        options.output,
        longer_edge=options.longer_edge,
        overwrite=options.overwrite,
        calibration=calibration,
    )
    checkpoint = resolve(options.checkpoint)
    provenance = read_provenance(checkpoint)
    longer_edge = options.longer_edge or provenance.longer_edge or LONGER_EDGE
    config = read_config(checkpoint, dtype=options.dtype)
    check_devices()
    enable_compilation_cache(options.compilation_cache)
    method = choose_method(provenance, None if options.method == "auto" else options.method)
    settings = _settings(options, method)
    needs = describe(source, target, config if options.dry_run else None, method, settings, longer_edge, point_filter)
    if provenance.longer_edge not in (None, longer_edge):
        source.notes.append(f"these weights were trained at {provenance.longer_edge} pixels, not {longer_edge}")
    said = len(source.notes)
    for note in source.notes:
        print(f"logvggt: note: {printable(note)}", file=sys.stderr)
    for line in needs:
        print(line if options.dry_run else f"logvggt: {line}", file=sys.stdout if options.dry_run else sys.stderr)
    if options.dry_run:
        return 0
    model, variables = from_pretrained(checkpoint, dtype=options.dtype)
    # Here rather than in the stream alone, so that nothing keeps the float32 parameters on the device.
    variables = in_compute_type(variables, model.config)
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
    )
    for note in source.notes[said:]:  # what only reading told
        print(f"logvggt: note: {printable(note)}", file=sys.stderr)
    print(result.summary())
    if not result.complete:
        if options.export:
            print("logvggt: note: not exported, since it is incomplete; see logvggt export --help", file=sys.stderr)
        return INTERRUPTED
    return _exports(result, options.export)


def _live(options: argparse.Namespace) -> int:
    from logvggt_jax.compile import check_devices, enable_compilation_cache
    from logvggt_jax.model.parameters import in_compute_type
    from logvggt_jax.reconstruction.live import LiveSession, OnlineSettings, Recording, online_stream
    from logvggt_jax.reconstruction.live.follow import follow
    from logvggt_jax.reconstruction.reconstruct import LONGER_EDGE
    from logvggt_jax.reconstruction.request import check_request
    from logvggt_jax.reconstruction.sources import open_source
    from logvggt_jax.streaming import expectation
    from logvggt_jax.weights import resolve
    from logvggt_jax.weights.checkpoints import from_pretrained, read_provenance

    thinned = {name: getattr(options, name) for name in ("stride", "fps")}
    source = open_source(options.camera, most_broken=1.0, **thinned)
    if source.address is not None and not options.realtime:
        raise InputError(f"{source.name} is no camera: add --realtime to play it as one, or use `logvggt reconstruct`")
    recording = None
    if options.output is not None:
        check_request(source, options.output, longer_edge=options.longer_edge, overwrite=options.overwrite)
        recording = Recording(options.output, overwrite=options.overwrite)
    online = OnlineSettings(options.period, options.context, options.max_registers)
    checkpoint = resolve(options.checkpoint)
    provenance = read_provenance(checkpoint)
    if doubt := expectation(provenance.trained_for, "windows"):
        warnings.warn(doubt, stacklevel=1)
    check_devices()
    enable_compilation_cache(options.compilation_cache)
    model, variables = from_pretrained(checkpoint, dtype=options.dtype)
    variables = in_compute_type(variables, model.config)
    session = LiveSession(
        lambda: online_stream(model, variables, online),
        longer_edge=options.longer_edge or provenance.longer_edge or LONGER_EDGE,
        capacity=model.config.windows.stride if options.queue is None else options.queue,
        recording=recording,
    )
    print(f"logvggt: {session.rule}", file=sys.stderr)
    print(f"logvggt: {online.text(model)}", file=sys.stderr)
    lost = follow(source, session, realtime=source.address is not None, reconnect=options.reconnect)
    report = session.report()
    print(json.dumps(report.as_json(), indent=1) if options.json else report.table())
    if session.reconstruction is not None:
        print(session.reconstruction.summary(), file=sys.stderr if options.json else sys.stdout)
    if lost is None:
        return 0
    print(f"logvggt: error: {one_line(InputError(lost))}", file=sys.stderr)
    return BAD_INPUT


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


def _export(options: argparse.Namespace) -> None:
    from logvggt_jax.reconstruction.exporters import export
    from logvggt_jax.reconstruction.point_cloud import PointFilter
    from logvggt_jax.reconstruction.result import Reconstruction

    points = None if options.max_points is None else PointFilter(max_points=options.max_points or None)
    result = Reconstruction.open(options.result)
    written = export(result, options.format, options.output, point_filter=points, overwrite=options.overwrite)
    for name, path in zip(dict.fromkeys(options.format), written, strict=True):
        print(f"{name}: {printable(str(path))}")


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
            raise InputError(f"{name} needs --mode chunks{' without --setting' if options.setting else ''}")
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


def _fuse(options: argparse.Namespace) -> None:
    from logvggt_jax.reconstruction.fusion.fuse import fuse
    from logvggt_jax.reconstruction.result import Reconstruction

    fused = fuse(
        Reconstruction.open(options.result),
        options.output,
        poses=options.poses,
        adjust=options.bundle_adjust,
        metric=options.metric,
        overwrite=options.overwrite,
    )
    _print_fused(fused)


def _scale(options: argparse.Namespace) -> None:
    from logvggt_jax.reconstruction.fusion.rescale import rescale
    from logvggt_jax.reconstruction.result import Reconstruction

    scaled = rescale(
        Reconstruction.open(options.result),
        options.output,
        poses=options.poses,
        depth=options.depth,
        depth_unit=options.depth_unit,
        frames=options.between_frames,
        pixels=options.between_pixels,
        distance=options.distance,
        overwrite=options.overwrite,
    )
    _print_fused(scaled)


def _print_fused(fused: Fused) -> None:
    for note in fused.notes:
        print(printable(note))
    print(fused.result.summary())


def _render_room(options: argparse.Namespace) -> None:
    from logvggt_jax.reconstruction.room_sequence import write_room_sequence

    folder = write_room_sequence(
        options.output,
        num_frames=options.frames,
        image_size=options.size,
        seed=options.seed,
        split=options.split,
        overwrite=options.overwrite,
    )
    print(f"{options.frames} frames with depth, poses and intrinsics: {folder}")


def _view(options: argparse.Namespace) -> None:
    from logvggt_jax.reconstruction.viewer import access_note, open_viewer, save_page, serve_forever

    if options.save is not None:
        shown, stored = save_page(options.folder, options.save, overwrite=options.overwrite)
        size = options.save.expanduser().stat().st_size / 1e6
        print(f"{printable(str(options.save))}: {shown:,} of {stored:,} points, {size:.1f} MB; open it in a browser")
        return
    server = open_viewer(options.folder, host=options.host, port=options.port)
    print(f"open http://{server.get_host()}:{server.get_port()} in a browser; Ctrl-C ends the viewer", flush=True)
    if note := access_note(options.host, server.get_port()):
        print(f"logvggt: {note}", file=sys.stderr)
    serve_forever(server)


def _info(options: argparse.Namespace) -> None:
    from rich.console import Console

    from logvggt_jax.compile import check_devices
    from logvggt_jax.weights.checkpoints import load_model, read_provenance
    from logvggt_jax.weights.summary import model_summary, provenance_lines

    check_devices()
    model, variables = load_model(options.checkpoint)
    console = Console()
    console.print(model_summary(model.config, variables["params"]))
    console.print(provenance_lines(read_provenance(options.checkpoint)), highlight=False, markup=False, soft_wrap=True)
    console.print("every parameter is finite and equals the digest stored with it")


def _check_data(options: argparse.Namespace) -> int:
    from logvggt_jax.data.checks.check import check_copy

    report = check_copy(
        options.name,
        options.root,
        split=options.split,
        max_sequences=options.max_sequences,
        all_images=options.all_images,
        picture=options.output,
        progress=True,
    )
    print(json.dumps(report.as_json(), indent=1) if options.json else report.text())
    return PROBLEMS_FOUND if report.problems else 0


def _pack_data(options: argparse.Namespace) -> None:
    from logvggt_jax.data.packed.pack import pack

    report = pack(
        options.name,
        options.root,
        options.output,
        split=options.split,
        frames_per_shard=options.frames_per_shard,
        workers=options.workers,
        progress=True,
    )
    print("\n".join(map(printable, report.text().splitlines())))


def _doctor(options: argparse.Namespace) -> int:
    from logvggt_jax.doctor.examination import QUICK, SHARES, examine, part_findings
    from logvggt_jax.doctor.finding import Finding

    if unknown := sorted(set(options.part or ()) - {*SHARES, *MODES}):
        raise InputError(f"doctor has no part {unknown[0]!r}; it has {', '.join((*SHARES, *MODES))}")
    parts = options.part or (MODES if options.methods else QUICK if options.quick else tuple(SHARES))
    marks = {True: "ok", False: "WRONG", None: ""}

    with contextlib.ExitStack() as stack:
        file = None
        if options.json not in (None, "-"):
            with disk_errors(options.json):
                file = stack.enter_context(Path(options.json).open("w"))

        def show(finding: Finding) -> None:
            if file is not None:
                print(finding.to_json(), file=file, flush=True)
            line = (
                f"{finding.part:15} {finding.what:42} {finding.value_text():>20}  {marks[finding.ok]:5} {finding.note}"
            )
            print(finding.to_json() if options.json == "-" else line.rstrip(), flush=True)

        if not options.in_process:
            return 0 if examine(parts, tiny=options.tiny, quick=options.quick, show=show) else PROBLEMS_FOUND
        # Of a part in a process of its own the exit code says whether it ran to its end.
        for part in parts:
            for finding in part_findings(part, tiny=options.tiny, quick=options.quick):
                show(finding)
    return 0


def _list_data(_: argparse.Namespace) -> None:
    from logvggt_jax.data.checks.catalogue import catalogue

    print(catalogue(min(shutil.get_terminal_size().columns, 120)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="logvggt",
        description="LoG-VGGT in JAX: camera poses, depth and point clouds from image sequences of any length.",
        epilog="`logvggt COMMAND --help` shows a command's options and an example.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    parser.set_defaults(traceback=False)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def command(
        name: str, run: Callable, summary: str, example: str, *, group: Any = commands, details: str = ""
    ) -> argparse.ArgumentParser:
        added = group.add_parser(
            name,
            help=summary,
            description=f"{summary[0].upper()}{summary[1:]}.{details}",
            epilog=f"example:\n  {example}",
            formatter_class=_Formatter,
        )
        added.set_defaults(run=run)
        added.add_argument("--traceback", action="store_true", help="show where in the code an error arose")
        return added

    sub = command(
        "convert",
        _convert,
        "turn a public VGGT checkpoint into a LoG-VGGT model folder",
        "logvggt convert facebook/VGGT-1B --output models/vggt-1b",
    )
    sub.add_argument(
        "source",
        help="VGGT checkpoint: a file of PyTorch or safetensors, its folder, or a hub repository, hf:OWNER/NAME[/FILE] "
        "or OWNER/NAME where no folder OWNER is here",
    )
    sub.add_argument("--output", type=Path, required=True, metavar="DIR", help="model folder to make")
    sub.add_argument("--point-head", action="store_true", help="keep the point head")
    sub.add_argument(
        "--trained-for",
        choices=("vggt", "causal"),
        default="vggt",
        help="vggt: all frames at once. causal: each frame sees those before it, as StreamVGGT's checkpoints, whose "
        "names and shapes are VGGT's",
    )
    sub.add_argument(
        "--keys", action="store_true", help="list every tensor that is used and what it becomes, not the others alone"
    )
    sub.add_argument("--overwrite", action="store_true", help="replace an earlier model folder")

    sub = command(
        "reconstruct",
        _reconstruct,
        "cameras, depth maps and a coloured point cloud from a folder of images or a video",
        "logvggt reconstruct walk.mp4 --stride 3 --checkpoint models/log-vggt --output runs/walk",
        details=" The work lies in OUTPUT.partial until it is done; a run that ended early, for whatever reason, is "
        "taken up by the same command. Ctrl-C ends the sequence at the window at hand and leaves a valid result of the "
        "frames so far; a second one stops at once.",
    )
    sub.add_argument("source", help="folder of images (natural order; 7-Scenes: its colour images), or a video")
    sub.add_argument(
        "--checkpoint",
        required=True,
        metavar="PATH_OR_REPO",
        help="`rooms`, the small model that ships; or a model folder, folder of a training run, VGGT checkpoint (a "
        "file, or its folder), or hub repository, hf:OWNER/NAME[/FILE] or OWNER/NAME where no folder OWNER is here",
    )
    sub.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    sub.add_argument(
        "--longer-edge",
        type=int,
        default=None,
        metavar="PIXELS",
        help="resize frames so that their longer edge has this size, a multiple of 14 (default: the size that the "
        "model was trained with)",
    )
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
    sub.add_argument(
        "--dtype", choices=("float32", "bfloat16"), default=None, help="compute type instead of the checkpoint's own"
    )
    sub.add_argument(
        "--method",
        "--mode",
        dest="method",
        choices=("auto", *MODES),
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
    known = sub.add_argument_group("camera").add_mutually_exclusive_group()
    known.add_argument(
        "--intrinsics",
        type=_pinhole,
        default=None,
        metavar="FX,FY,CX,CY",
        help="focal lengths and principal point of all frames where they are known, in pixels of the original images "
        "with centres at integers, instead of the model's",
    )
    known.add_argument(
        "--shared-intrinsics",
        action="store_true",
        help="all frames have one camera: take the median of the model's focal lengths for all",
    )
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
    sub.add_argument(
        "--overwrite", action="store_true", help="begin anew and replace an earlier or unfinished reconstruction"
    )
    sub.add_argument(
        "--dry-run",
        action="store_true",
        help="check everything that can be checked before the weights are read, compile the program, and print frames, "
        "size, memory and time",
    )
    sub.add_argument(
        "--compilation-cache",
        default=None,
        metavar="DIR",
        help="where compiled programs are kept between runs, 'none' for nowhere (default: $JAX_COMPILATION_CACHE_DIR "
        "or the user's cache folder)",
    )

    sub = command(
        "live",
        _live,
        "depth and poses while a camera or a network stream is looked through",
        "logvggt live 0 --checkpoint models/log-vggt --output runs/now",
        details=" Frames that come faster than they are used wait in a short queue; when it is full, the one that has "
        "waited longest is dropped, and counted. Time a frame and memory do not grow. How it keeps up, and how long "
        "every stage takes (median, and 95 % in brackets), is said on standard error while it runs and as a table at "
        "the end. Ctrl-C ends the sequence; where the camera is lost, what is final stays.",
    )
    sub.add_argument(
        "camera", help="number of a camera (0), address of a stream (rtsp://…, http://…), or a video, with --realtime"
    )
    sub.add_argument("--checkpoint", required=True, metavar="PATH_OR_REPO", help="model, as for `logvggt reconstruct`")
    sub.add_argument(
        "--output", type=Path, default=None, metavar="DIR", help="folder to make, as `logvggt reconstruct` makes it"
    )
    sub.add_argument("--overwrite", action="store_true", help="replace an earlier reconstruction")
    sub.add_argument(
        "--longer-edge",
        type=int,
        default=None,
        metavar="PIXELS",
        help="resize frames so that their longer edge has this size, a multiple of 14 (default: the size that the "
        "model was trained with)",
    )
    sub.add_argument(
        "--queue",
        type=int,
        default=None,
        metavar="N",
        help="frames that may wait (default: the windows' stride, what a window takes at once)",
    )
    sub.add_argument("--stride", type=int, default=1, metavar="N", help="look at every N-th frame alone")
    sub.add_argument("--fps", type=float, default=None, metavar="N", help="look at N frames a second at most")
    sub.add_argument("--realtime", action="store_true", help="play a video at its own pace, as if it were a camera")
    sub.add_argument(
        "--reconnect",
        type=float,
        default=None,
        metavar="SECONDS",
        help="try for so long to reach a camera or stream again that was lost",
    )
    sub.add_argument(
        "--period",
        type=int,
        default=None,
        metavar="N",
        help="new frames after which poses are final (default: the windows' stride)",
    )
    sub.add_argument("--context", type=int, default=32, metavar="N", help="newest frames that the camera head sees")
    sub.add_argument(
        "--max-registers", type=int, default=1024, metavar="N", help="register tokens that GCCR reads, four a frame"
    )
    sub.add_argument(
        "--dtype", choices=("float32", "bfloat16"), default=None, help="compute type instead of the checkpoint's own"
    )
    sub.add_argument("--json", action="store_true", help="print the numbers at the end as JSON, in seconds")
    sub.add_argument("--compilation-cache", default=None, metavar="DIR", help="as for `logvggt reconstruct`")

    sub = command(
        "export",
        _export,
        "write a finished reconstruction in formats that other programs open",
        "logvggt export runs/walk --format colmap --format glb --output scenes/walk",
        details=" Every format becomes a file or folder of its own in the output: colmap/ and colmap-text/ (pictures, "
        "model and cloud with tracks, as 3D Gaussian splatting starts from), nerfstudio/ (transforms.json), scene.glb, "
        "points.ply, the camera's path as tum.txt, kitti.txt and euroc.csv, depth at the size of the original images "
        "as depth-png/ (16 bits and a scale), depth-exr/ and depth-npz/, and rosbag2/. Pictures are read from the "
        "source once more; where it is gone or has changed, those that the result keeps are taken, and that is said.",
    )
    sub.add_argument("result", type=Path, help="output of `logvggt reconstruct`")
    sub.add_argument(
        "--format",
        action="append",
        required=True,
        choices=FORMATS,
        metavar="FORMAT",
        help=f"one of {', '.join(FORMATS)}; may be given several times",
    )
    sub.add_argument(
        "--output", type=Path, default=None, metavar="DIR", help="folder for them (default: RESULT/exports)"
    )
    sub.add_argument(
        "--max-points",
        type=int,
        default=None,
        metavar="N",
        help="thin the cloud to N points; 0 keeps all (default: 2,000,000 for ply, 500,000 for glb, else 100,000)",
    )
    sub.add_argument("--overwrite", action="store_true", help="replace earlier exports of these formats")

    sub = command(
        "fuse",
        _fuse,
        "rebuild a reconstruction from better cameras, as a new one",
        "logvggt fuse runs/walk --poses colmap/sparse/0 --output runs/walk-colmap",
        details=" Depth is scaled frame by frame to agree with the cameras and with its neighbours, points are made "
        "anew. How well cameras and depth agree, before and after, is printed. Intrinsics that come with the poses are "
        "taken if they are pinholes; else they stay.",
    )
    sub.add_argument("result", type=Path, help="output of `logvggt reconstruct`, which is only read")
    sub.add_argument(
        "--poses",
        default=None,
        metavar="FILE",
        help="cameras of another program: a folder with COLMAP's images.bin or .txt (also in sparse/0), nerfstudio's "
        "transforms.json, or a trajectory in TUM's format. Pictures are found by name, times to half a frame's step; "
        "frames without a pose are left out",
    )
    sub.add_argument("--metric", action="store_true", help="lengths of these poses are metres")
    sub.add_argument(
        "--bundle-adjust",
        action="store_true",
        help="move the cameras until corners of the images, found again with the help of depth, agree with them "
        "(needs the extra `colmap`)",
    )
    sub.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    sub.add_argument("--overwrite", action="store_true", help="replace an earlier reconstruction")

    sub = command(
        "scale",
        _scale,
        "turn a reconstruction's lengths into metres, as a new one",
        "logvggt scale runs/walk --between-frames 0 120 --distance 4.5 --output runs/walk-metres",
        details=" One way to know the scale is given. The factor is printed, and how well what it was found from "
        "agrees.",
    )
    sub.add_argument("result", type=Path, help="output of `logvggt reconstruct`, which is only read")
    ways = sub.add_mutually_exclusive_group(required=True)
    ways.add_argument("--poses", default=None, metavar="FILE", help="cameras in metres, files as for `logvggt fuse`")
    ways.add_argument(
        "--depth",
        type=Path,
        default=None,
        metavar="DIR",
        help="depth of a sensor, 16-bit PNG files whose names begin as the frames'",
    )
    ways.add_argument(
        "--between-frames", nargs=2, default=None, metavar="FRAME", help="two frames (name or number) --distance apart"
    )
    ways.add_argument(
        "--between-pixels",
        nargs=2,
        default=None,
        metavar="FRAME,U,V",
        help="two pixels of original images that show points --distance apart",
    )
    sub.add_argument("--distance", type=float, default=None, metavar="METRES", help="between the two frames or pixels")
    sub.add_argument("--depth-unit", type=float, default=0.001, metavar="METRES", help="what a level of the depth is")
    sub.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    sub.add_argument("--overwrite", action="store_true", help="replace an earlier reconstruction")

    sub = command(
        "render-room",
        _render_room,
        "write a procedural room as a 7-Scenes-like sequence with exact depth, poses and intrinsics",
        "logvggt render-room --output runs/room --frames 48 --size 120x160 --seed 1",
    )
    sub.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    sub.add_argument("--frames", type=int, default=48, metavar="N", help="length of the sequence")
    sub.add_argument("--size", type=_size, default=(120, 160), metavar="HxW", help="height and width in pixels")
    sub.add_argument("--seed", type=int, default=0, help="which room")
    sub.add_argument(
        "--split", choices=("train", "val", "test"), default="test", help="rooms of training, validation or test"
    )
    sub.add_argument("--overwrite", action="store_true", help="replace an earlier sequence")

    sub = command(
        "view",
        _view,
        "look at a reconstruction in the browser",
        "logvggt view runs/walk",
        details=" Only this machine's browser reaches the page. From another machine, open a tunnel: "
        "ssh -N -L 8080:localhost:8080 USER@THIS_MACHINE. With --save nothing is served: one file of less than 25 MB "
        "holds the scene, thinned to fit, and opens anywhere.",
    )
    sub.add_argument("folder", type=Path, help="output of `logvggt reconstruct`")
    sub.add_argument("--port", type=int, default=8080, help="of the web page; the next free one if in use")
    sub.add_argument("--host", default="127.0.0.1", help="serve at this address, to the network that it belongs to")
    sub.add_argument(
        "--save", type=Path, default=None, metavar="PAGE", help="write one HTML file to keep or send instead of serving"
    )
    sub.add_argument("--overwrite", action="store_true", help="replace an earlier page")

    sub = command(
        "info",
        _info,
        "sizes and parameters of a model folder, after a check of every stored digest",
        "logvggt info models/vggt-1b",
    )
    sub.add_argument(
        "checkpoint",
        help="model folder made by `logvggt convert`, folder of a training run, or `rooms`, the model that ships",
    )

    sub = command(
        "doctor",
        _doctor,
        "what this machine has, whether the model computes right on it, and how fast",
        "logvggt doctor --quick",
        details=" Parts run one after the other, each in a process of its own, five minutes in all and one with "
        "--quick: environment (versions, devices, builds that do not belong together), parity (a small network "
        "against recorded values), inference (kernels, memory, time and utilisation of a step), training (the same "
        "for the training step), whole (from files to files). With --methods each method of `reconstruct --method` is "
        "such a part: its frames a second at VGGT-1B's size, beside what the originals in PyTorch reach on one H100. "
        "On a CPU the model is a tiny one, and nothing is compared. Exit code 0: nothing wrong, 1: something is.",
    )
    sub.add_argument("--quick", action="store_true", help="environment, parity and inference alone, in a minute")
    sub.add_argument("--methods", action="store_true", help="every method's frames a second instead of the other parts")
    sub.add_argument(
        "--part", action="append", metavar="NAME", help="this part, or method, alone; may be given several times"
    )
    sub.add_argument("--tiny", action="store_true", help="the tiny model on an accelerator as well")
    sub.add_argument(
        "--json",
        nargs="?",
        const="-",
        metavar="FILE",
        help="write one JSON object a line to a file as well, or print them instead of the table (no file, or -)",
    )
    sub.add_argument("--in-process", action="store_true", help=argparse.SUPPRESS)

    data = commands.add_parser("data", help="data sets: what there is, and whether a copy on disk is sound")
    data_commands = data.add_subparsers(title="commands", metavar="COMMAND", required=True)

    sub = command(
        "check",
        _check_data,
        "walk a copy of a data set and report what it holds and what is missing or broken",
        "logvggt data check replica /data/replica --output replica.png",
        group=data_commands,
        details=" Prints sequences, frames, frames without pose, depth ranges, how well depth and poses of different "
        "frames agree, and every problem with its file and mend. Exit code 0: clean, 1: problems found, 2: bad input.",
    )
    sub.add_argument("name", help="data set, as `logvggt data list` names it")
    sub.add_argument("root", type=Path, help="folder of the copy")
    sub.add_argument(
        "--split", choices=("train", "val", "test", "all"), default="all", help="only this split's sequences"
    )
    sub.add_argument(
        "--max-sequences", type=int, default=None, metavar="N", help="look at N sequences, evenly spread over the set"
    )
    sub.add_argument(
        "--all-images", action="store_true", help="open every picture instead of a few of each sequence; takes long"
    )
    sub.add_argument(
        "--output",
        type=Path,
        default=None,
        metavar="PICTURE",
        help="PNG file to write: frames, their depth, and the cameras from above",
    )
    sub.add_argument("--json", action="store_true", help="print the whole report as JSON")

    sub = command(
        "pack",
        _pack_data,
        "write a data set's frames into shards that training reads in its folder's place",
        "logvggt data pack scannet /data/scannet --split train --output /packed/scannet --workers 8",
        group=data_commands,
        details=" Training on the packed folder (--config.data.sources.scannet.root=/packed/scannet) draws the same "
        "clips. Every frame is stored as the reader hands it out, without loss, so that nothing is decoded again. The "
        "same command goes on after an interruption, and writes anew what is damaged. What cannot be read is named and "
        "fails in training as it did before.",
    )
    sub.add_argument("name", help="data set, as `logvggt data list` names it")
    sub.add_argument("root", type=Path, help="folder of the copy")
    sub.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="folder to write the shards to")
    sub.add_argument(
        "--split", choices=("train", "val", "test", "all"), default="all", help="only this split's sequences"
    )
    sub.add_argument(
        "--frames-per-shard", type=int, default=2000, metavar="N", help="a sequence is never divided between shards"
    )
    sub.add_argument("--workers", type=int, default=1, metavar="N", help="processes that read and write shards")

    command(
        "list",
        _list_data,
        "every data set: what its folder must hold, how to obtain it, its licence and size",
        "logvggt data list",
        group=data_commands,
        details=" Archives are never unpacked by this package: unpack them with your own tools.",
    )
    return parser


class _Formatter(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Keeps the example's line and shows defaults that say something."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default in (None, False):
            return action.help
        if isinstance(action.default, tuple):
            return f"{action.help} (default: {'x'.join(map(str, action.default))})"
        return super()._get_help_string(action)


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"logvggt {version('logvggt-jax')}")
        parser.exit()


def _size(text: str) -> tuple[int, int]:
    height, separator, width = text.lower().partition("x")
    if not (separator and height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise argparse.ArgumentTypeError(f"expected height x width such as 120x160, got {text!r}")
    return int(height), int(width)


def _pinhole(text: str) -> tuple[float, ...]:
    try:
        fx, fy, cx, cy = (float(number) for number in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected FX,FY,CX,CY such as 1400,1400,960,540, got {text!r}") from None
    return fx, fy, cx, cy


def _with_dashes(arguments: Sequence[str]) -> list[str]:
    """Option names with underscores, as train.py and eval.py spell theirs, in the spelling with dashes."""
    result = []
    for argument in arguments:
        if argument.startswith("--"):
            name, equals, value = argument.partition("=")
            argument = name.replace("_", "-") + equals + value
        result.append(argument)
    return result


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    print(f"logvggt: warning: {printable(str(message))}", file=sys.stderr)
