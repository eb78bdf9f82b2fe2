"""What every method costs on this device, in one run: frames a second, operations and kept bytes of a frame.

    python benchmarks/methods.py
    python benchmarks/methods.py --checkpoint models/vggt-1b --image-size 392x518 --dtype bfloat16

Without a checkpoint the model is that of configs/tiny.py with random parameters; values do not matter to the time.
Pictures are in host memory and depth goes back to it, both within the time. A method's first stream of a length
compiles and does not count; how many programs XLA makes in the timed ones is printed, and should be none.

Operations are those of the program in which a method spends its time at the sequence's last frame, the costliest, over
the frames that become final with it; a cache counts with its empty places, which a CPU computes as well. Bytes are the
most that are kept between two frames for those to come, over the sequence's frames.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.table import Table
from subject import add_options, subject

from logvggt_jax.evaluation.costs.streams import cost_of_length, random_pictures, unlimited_settings
from logvggt_jax.evaluation.environment import describe_device
from logvggt_jax.evaluation.methods.method import Checkpoint, model_row
from logvggt_jax.model.parameters import in_compute_type
from logvggt_jax.streaming import METHODS


def measure(checkpoint: Checkpoint, options: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for each length and method, shortest first."""
    pictures, rows = random_pictures(options.image_size), []
    for length in sorted(options.lengths):
        for method in options.methods:
            settings = unlimited_settings(method)
            cost = cost_of_length(model_row(method, checkpoint, settings), pictures, length, options.rounds)
            program = METHODS[method].program(checkpoint.model, options.image_size, settings, length)
            rows.append({"method": method, "frames": length, "flops": program.flops / program.frames, **cost})
    return rows


def print_table(console: Console, rows: list[dict[str, Any]]) -> None:
    """All rows, and what frames a second are over those of `windows` at the same length."""
    table = Table("frames", "method", "frames/s", "over windows", "GFLOP a frame", "state, kB a frame", "compilations")
    rates = {
        (row["method"], row["frames"]): statistics.median(row["frames_per_second"])
        for row in rows
        if "reason" not in row
    }
    for row in rows:
        rate, windows = (rates.get((method, row["frames"])) for method in (row["method"], "windows"))
        table.add_row(
            str(row["frames"]),
            row["method"],
            row["reason"] if rate is None else f"{rate:.4g}",
            "-" if rate is None or windows is None else f"{rate / windows:.2f}",
            f"{row['flops'] / 1e9:,.4g}",
            "-" if rate is None else f"{row['state_bytes'] / row['frames'] / 1e3:,.4g}",
            "-" if rate is None else str(row["compilations"]),
        )
    console.print(table)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_options(parser)
    parser.add_argument("--lengths", type=int, nargs="+", default=[50, 100, 500], help="frames of the streams")
    parser.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=list(METHODS), help="default all")
    parser.add_argument("--rounds", type=int, default=3, help="timed streams of every length and method")
    parser.add_argument("--output", type=Path, help="JSON file to write as well")
    options = parser.parse_args()
    console = Console()
    console.width = max(console.width, 110)
    model, variables = subject(options)
    checkpoint = Checkpoint(model, jax.device_put(in_compute_type(variables, model.config)), "")
    height, width = options.image_size
    console.print(f"{describe_device()}, {checkpoint.model.config.dtype}, {width} x {height} pixels, batch 1")
    rows = measure(checkpoint, options)
    print_table(console, rows)
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
