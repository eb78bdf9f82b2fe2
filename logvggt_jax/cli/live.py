"""`logvggt live`: a camera or a network stream is followed while it runs."""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from typing import Any

from logvggt_jax.cli.command import (
    add_command,
    calibration_options,
    execution_options,
    given_path,
    loaded_model,
    longer_edge_option,
    overwrite_option,
)
from logvggt_jax.cli.exit_codes import BAD_INPUT
from logvggt_jax.cli.viewing import check_watch, stay_open, watch_options, watched
from logvggt_jax.errors import InputError, one_line


def _live(options: argparse.Namespace) -> int:
    from logvggt_jax.compile import check_devices, enable_compilation_cache
    from logvggt_jax.files import check_apart
    from logvggt_jax.model.low_precision import check_precision
    from logvggt_jax.reconstruction.calibration import Calibration
    from logvggt_jax.reconstruction.live import LiveSession, OnlineSettings, Recording, online_stream
    from logvggt_jax.reconstruction.live.follow import check_answers, follow
    from logvggt_jax.reconstruction.reconstruct import LONGER_EDGE
    from logvggt_jax.reconstruction.request import check_request
    from logvggt_jax.reconstruction.sources import open_source
    from logvggt_jax.streaming import expectation
    from logvggt_jax.weights import resolve
    from logvggt_jax.weights.checkpoints import read_provenance

    thinned = {name: getattr(options, name) for name in ("stride", "fps")}
    source = open_source(options.camera, masks=options.masks, most_broken=1.0, **thinned)
    if source.address is not None and not options.realtime:
        raise InputError(f"{source.name} is no camera: add --realtime to play it as one, or use `logvggt reconstruct`")
    if source.address is not None and options.reconnect is not None:
        raise InputError(f"{source.name} ends where it ends, and there is nothing to wait for: leave --reconnect out")
    if options.queue is not None and options.queue < 1:
        raise InputError(f"--queue must be at least 1 frame, got {options.queue}")
    for name in ("period", "context", "max_registers"):
        if (count := getattr(options, name)) is not None and count < 1:
            raise InputError(f"--{name.replace('_', '-')} must be at least 1, got {count}")
    check_watch(options)
    target, recording, calibration = None, None, Calibration(options.intrinsics, options.shared_intrinsics)
    if options.output is not None:
        target = check_request(
            source,
            options.output,
            longer_edge=options.longer_edge,
            overwrite=options.overwrite,
            calibration=calibration,
        )
        recording = Recording(
            options.output,
            calibration=calibration,
            keep_originals=options.keep_originals,
            overwrite=options.overwrite,
        )
    elif calibration != Calibration():
        raise InputError("--intrinsics and --shared-intrinsics are of a result: give --output, too")
    elif options.keep_originals:
        raise InputError("--keep-originals is of a result: give --output, too")
    online = OnlineSettings(options.period, options.context, options.max_registers)
    checkpoint = resolve(options.checkpoint)
    if target is not None:
        check_apart(target, [checkpoint])
    provenance = read_provenance(checkpoint)
    if doubt := expectation(provenance.trained_for, "windows"):
        warnings.warn(doubt, stacklevel=1)
    check_devices()
    if options.precision and (note := check_precision(options.precision)):
        warnings.warn(note, stacklevel=1)
    if options.reconnect is None:
        check_answers(source)
    enable_compilation_cache(options.compilation_cache)
    with watched(options) as window:
        model, variables = loaded_model(checkpoint, options)
        session = LiveSession(
            lambda: online_stream(model, variables, online, provisional=window is not None),
            longer_edge=options.longer_edge or provenance.longer_edge or LONGER_EDGE,
            capacity=model.config.windows.stride if options.queue is None else options.queue,
            on_result=None if window is None else window.add,
            recording=recording,
        )
        print(f"logvggt: {session.rule}", file=sys.stderr)
        print(f"logvggt: {online.text(model)}", file=sys.stderr)
        lost = follow(source, session, realtime=source.address is not None, reconnect=options.reconnect)
        report = session.report()
        print(json.dumps(report.as_json(), indent=1) if options.json else report.table())
        if session.reconstruction is not None:
            print(session.reconstruction.summary(), file=sys.stderr if options.json else sys.stdout)
        if lost is not None:
            print(f"logvggt: error: {one_line(InputError(lost))}", file=sys.stderr)
        if session.signal in (None, "SIGINT"):  # others ask the process to end
            stay_open(window, session.reconstruction)
    return 0 if lost is None else BAD_INPUT


def add_to(commands: Any) -> None:
    """Adds the command."""
    sub = add_command(
        commands,
        "live",
        _live,
        "depth and poses while a camera or a network stream is looked through",
        "logvggt live 0 --checkpoint models/log-vggt --output runs/now",
        details=" Frames that come faster than they are used wait in a short queue; when it is full, the one that has "
        "waited longest is dropped, and counted. Time a frame and memory of the device do not grow; a recording "
        "keeps 2.7 kB a frame in the host's memory. How it keeps up, and how long "
        "every stage takes (median, and 95 % in brackets), is said on standard error while it runs and as a table at "
        "the end. Ctrl-C ends the sequence; where the camera is lost, what is final stays.",
    )
    sub.add_argument(
        "camera", help="number of a camera (0), address of a stream (rtsp://…, http://…), or a video, with --realtime"
    )
    sub.add_argument("--checkpoint", required=True, metavar="PATH_OR_REPO", help="model, as for `logvggt reconstruct`")
    sub.add_argument(
        "--output",
        type=given_path,
        default=None,
        metavar="DIR",
        help="folder to make, as `logvggt reconstruct` does",
    )
    overwrite_option(sub, "an earlier reconstruction")
    sub.add_argument(
        "--keep-originals",
        action="store_true",
        help="keep the frames that are used at the camera's own size, too (originals/, as JPEG), so that `logvggt "
        "export` has them",
    )
    longer_edge_option(sub)
    sub.add_argument(
        "--queue",
        type=int,
        default=None,
        metavar="N",
        help="frames that may wait (default: the windows' stride, what a window takes at once)",
    )
    sub.add_argument(
        "--masks",
        default=None,
        metavar="PATH",
        help="one picture for all frames (a robot's arm, a car's bonnet, dirt on the lens): what is black or "
        "transparent there has no influence, no depth and no points; for a video a folder, too, as for `logvggt "
        "reconstruct`",
    )
    calibration_options(sub)
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
    execution_options(sub)
    watch_options(sub)
    sub.add_argument("--json", action="store_true", help="print the numbers at the end as JSON, in seconds")
