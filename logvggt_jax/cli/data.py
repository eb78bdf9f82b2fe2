"""`logvggt data list`, `check` and `pack`, and `render-room`: data sets on the disk."""

from __future__ import annotations

import argparse
import json
import shutil
from typing import Any

from logvggt_jax.cli.command import add_command, given_path, output_option, overwrite_option
from logvggt_jax.cli.exit_codes import PROBLEMS_FOUND
from logvggt_jax.errors import printable


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


def _list_data(_: argparse.Namespace) -> None:
    from logvggt_jax.data.checks.catalogue import catalogue

    print(catalogue(min(shutil.get_terminal_size().columns, 120)))


def _size(text: str) -> tuple[int, int]:
    height, separator, width = text.lower().partition("x")
    if not (separator and height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise argparse.ArgumentTypeError(f"expected height x width such as 120x160, got {text!r}")
    return int(height), int(width)


def _copy_arguments(parser: argparse.ArgumentParser) -> None:
    """Which copy of a data set, and which part of it."""
    parser.add_argument("name", help="data set, as `logvggt data list` names it")
    parser.add_argument("root", type=given_path, help="folder of the copy")
    parser.add_argument(
        "--split", choices=("train", "val", "test", "all"), default="all", help="only this split's sequences"
    )


def add_to(commands: Any) -> None:
    """Adds the commands about data."""
    sub = add_command(
        commands,
        "render-room",
        _render_room,
        "write a procedural room as a 7-Scenes-like sequence with exact depth, poses and intrinsics",
        "logvggt render-room --output runs/room --frames 48 --size 120x160 --seed 1",
    )
    output_option(sub)
    sub.add_argument("--frames", type=int, default=48, metavar="N", help="length of the sequence")
    sub.add_argument("--size", type=_size, default=(120, 160), metavar="HxW", help="height and width in pixels")
    sub.add_argument("--seed", type=int, default=0, help="which room")
    sub.add_argument(
        "--split", choices=("train", "val", "test"), default="test", help="rooms of training, validation or test"
    )
    overwrite_option(sub, "an earlier sequence")

    data = commands.add_parser("data", help="data sets: what there is, and whether a copy on disk is sound")
    data_commands = data.add_subparsers(title="commands", metavar="COMMAND", required=True)

    sub = add_command(
        data_commands,
        "check",
        _check_data,
        "walk a copy of a data set and report what it holds and what is missing or broken",
        "logvggt data check replica /data/replica --output replica.png",
        details=" Prints sequences, frames, frames without pose, depth ranges, how well depth and poses of different "
        "frames agree, and every problem with its file and mend. Exit code 0: clean, 1: problems found, 2: bad input.",
    )
    _copy_arguments(sub)
    sub.add_argument(
        "--max-sequences", type=int, default=None, metavar="N", help="look at N sequences, evenly spread over the set"
    )
    sub.add_argument(
        "--all-images", action="store_true", help="open every picture instead of a few of each sequence; takes long"
    )
    sub.add_argument(
        "--output",
        type=given_path,
        default=None,
        metavar="PICTURE",
        help="PNG file to write: frames, their depth, and the cameras from above",
    )
    sub.add_argument("--json", action="store_true", help="print the whole report as JSON")

    sub = add_command(
        data_commands,
        "pack",
        _pack_data,
        "write a data set's frames into shards that training reads in its folder's place",
        "logvggt data pack scannet /data/scannet --split train --output /packed/scannet --workers 8",
        details=" Training on the packed folder (--config.data.sources.scannet.root=/packed/scannet) draws the same "
        "clips. Every frame is stored as the reader hands it out, without loss, so that nothing is decoded again. The "
        "same command goes on after an interruption, and writes anew what is damaged, and what was corrected in the "
        "data set since. What cannot be read is named and fails in training as it did before.",
    )
    _copy_arguments(sub)
    sub.add_argument("--output", type=given_path, required=True, metavar="FOLDER", help="folder to write the shards to")
    sub.add_argument(
        "--frames-per-shard", type=int, default=2000, metavar="N", help="a sequence is never divided between shards"
    )
    sub.add_argument("--workers", type=int, default=1, metavar="N", help="processes that read and write shards")

    add_command(
        data_commands,
        "list",
        _list_data,
        "every data set: what its folder must hold, how to obtain it, its licence and size",
        "logvggt data list",
        details=" Archives are never unpacked by this package: unpack them with your own tools.",
    )
