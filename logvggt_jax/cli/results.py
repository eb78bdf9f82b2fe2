"""`logvggt export`, `fuse`, `scale` and `view`: what can be done with a finished reconstruction."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from logvggt_jax.cli.choices import FORMATS
from logvggt_jax.cli.command import add_command, given_path, output_option, overwrite_option
from logvggt_jax.cli.viewing import address, address_options, check_unserved, say_access
from logvggt_jax.errors import printable

if TYPE_CHECKING:
    from logvggt_jax.reconstruction.fusion.fuse import Fused


def _export(options: argparse.Namespace) -> None:
    from logvggt_jax.reconstruction.exporters import export
    from logvggt_jax.reconstruction.result import Reconstruction

    result = Reconstruction.open(options.result)
    points = None if options.max_points is None else result.filtered(options.max_points or None)
    written = export(result, options.format, options.output, point_filter=points, overwrite=options.overwrite)
    for name, path in zip(dict.fromkeys(options.format), written, strict=True):
        print(f"{name}: {printable(str(path))}")


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


def _view(options: argparse.Namespace) -> None:
    from logvggt_jax.reconstruction.viewer import open_viewer, save_page, serve_until_interrupt, stop_server

    if options.save is not None:
        check_unserved(options, "with --save it is a file, leave them out")
        shown, stored = save_page(options.folder, options.save, overwrite=options.overwrite)
        size = options.save.expanduser().stat().st_size / 1e6
        print(f"{printable(str(options.save))}: {shown:,} of {stored:,} points, {size:.1f} MB; open it in a browser")
        return
    server = open_viewer(options.folder, host=options.host, port=options.port)
    print(f"open {address(server)} in a browser; Ctrl-C ends the viewer", flush=True)
    say_access(server, options.host)
    serve_until_interrupt()
    stop_server(server)


def _result_argument(parser: argparse.ArgumentParser, reading: str = "") -> None:
    parser.add_argument("result", type=given_path, help=f"output of `logvggt reconstruct`{reading}")


def add_to(commands: Any) -> None:
    """Adds the commands about results."""
    sub = add_command(
        commands,
        "export",
        _export,
        "write a finished reconstruction in formats that other programs open",
        "logvggt export runs/walk --format colmap --format glb --output scenes/walk",
        details=" Every format becomes a file or folder of its own in the output: colmap/ and colmap-text/ (pictures, "
        "model and cloud with tracks, as 3D Gaussian splatting starts from), nerfstudio/ (transforms.json), scene.glb, "
        "points.ply, splats.ply (a Gaussian for each point, for SuperSplat), the camera's path as tum.txt, kitti.txt "
        "and euroc.csv, depth at the size of the original images as depth-png/ (16 bits and a scale), depth-exr/ and "
        "depth-npz/, and rosbag2/. Pictures are read from the source once more; where it is gone or has changed, "
        "those that the result keeps are taken, and that is said.",
    )
    _result_argument(sub)
    sub.add_argument(
        "--format",
        action="append",
        required=True,
        choices=FORMATS,
        metavar="FORMAT",
        help=f"one of {', '.join(FORMATS)}; may be given several times",
    )
    sub.add_argument(
        "--output", type=given_path, default=None, metavar="DIR", help="folder for them (default: RESULT/exports)"
    )
    sub.add_argument(
        "--max-points",
        type=int,
        default=None,
        metavar="N",
        help="thin the cloud to N points; 0 keeps all (default: as the result was made for ply, 500,000 for glb and "
        "splats, else 100,000); pixels are those that the result's filter takes",
    )
    sub.add_argument("--overwrite", action="store_true", help="replace earlier exports of these formats")

    sub = add_command(
        commands,
        "fuse",
        _fuse,
        "rebuild a reconstruction from better cameras, as a new one",
        "logvggt fuse runs/walk --poses colmap/sparse/0 --output runs/walk-colmap",
        details=" Depth is scaled frame by frame to agree with the cameras and with its neighbours, points are made "
        "anew. How well cameras and depth agree, before and after, is printed. Intrinsics that come with the poses are "
        "taken if they are pinholes; else they stay.",
    )
    _result_argument(sub, ", which is only read")
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
    output_option(sub)
    overwrite_option(sub, "an earlier reconstruction")

    sub = add_command(
        commands,
        "scale",
        _scale,
        "turn a reconstruction's lengths into metres, as a new one",
        "logvggt scale runs/walk --between-frames 0 120 --distance 4.5 --output runs/walk-metres",
        details=" One way to know the scale is given. The factor is printed, and how well what it was found from "
        "agrees.",
    )
    _result_argument(sub, ", which is only read")
    ways = sub.add_mutually_exclusive_group(required=True)
    ways.add_argument("--poses", default=None, metavar="FILE", help="cameras in metres, files as for `logvggt fuse`")
    ways.add_argument(
        "--depth",
        type=given_path,
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
    sub.add_argument(
        "--depth-unit",
        type=float,
        default=None,
        metavar="METRES",
        help="what a level of the sensor's depth is (default: 0.001)",
    )
    output_option(sub)
    overwrite_option(sub, "an earlier reconstruction")

    sub = add_command(
        commands,
        "view",
        _view,
        "look at a reconstruction in the browser",
        "logvggt view runs/walk",
        details=" Only this machine's browser reaches the page. From another machine, open a tunnel: "
        "ssh -N -L 8080:localhost:8080 USER@THIS_MACHINE. With --save nothing is served: one file of less than 25 MB "
        "holds the scene, thinned to fit, and opens anywhere.",
    )
    sub.add_argument("folder", type=given_path, help="output of `logvggt reconstruct`")
    address_options(sub)
    sub.add_argument(
        "--save",
        type=given_path,
        default=None,
        metavar="PAGE",
        help="write one HTML file to keep instead of serving",
    )
    overwrite_option(sub, "an earlier page")
