"""What a stream costs on this device: frames a second by length, time and operations by part, latency, memory.

    python benchmarks/efficiency.py --output runs/efficiency
    python benchmarks/efficiency.py --checkpoint models/vggt-1b --image-size 392x518 --dtype bfloat16 --output runs/1b

Without a checkpoint the model is that of configs/tiny.py with random parameters; values do not matter to the time.
Frames are uint8 pictures in host memory and depth goes back to it, both within the time; reading and resizing files is
not. Depth is decoded for every frame. Every program is compiled and run once before it counts. Tables are printed;
efficiency.json and efficiency.png go into the output folder. XLA_PYTHON_CLIENT_PREALLOCATE=false is set, so that peak
memory means something.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import statistics
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table
from subject import add_options, subject

from logvggt_jax import LogVGGT
from logvggt_jax.compile import most_device_bytes
from logvggt_jax.evaluation.costs.parts import (
    PARTS,
    PartTime,
    flops_by_part,
    peak_host_bytes,
    sequence_parts,
    spread,
    time_part,
)
from logvggt_jax.evaluation.costs.streams import random_pictures, time_stream
from logvggt_jax.evaluation.environment import describe_device
from logvggt_jax.evaluation.methods.variants import VARIANTS
from logvggt_jax.evaluation.report.figures import efficiency_plot
from logvggt_jax.operations import matmul_flops_per_second
from logvggt_jax.streaming import open_predictor

MIB = 2**20


def speed(
    models: dict[str, LogVGGT], variables: Any, pictures: np.ndarray, lengths: list[int], rounds: int
) -> list[dict[str, Any]]:
    """Frames a second of every mode at every length, shortest first, so that peaks of memory can be read off."""
    rows = []
    for length in sorted(lengths):
        for mode, model in models.items():
            warm = time_stream(open_predictor("windows", model, variables), pictures, length, watch=True)
            runs = [time_stream(open_predictor("windows", model, variables), pictures, length) for _ in range(rounds)]
            rows.append(
                {
                    "mode": mode,
                    "frames": length,
                    "frames_per_second": [length / run.seconds for run in runs],
                    "first_result_seconds": statistics.median(run.first_result for run in runs),
                    "step_seconds": statistics.median(step for run in runs for step in run.steps),
                    "step_seconds_95": float(np.percentile([step for run in runs for step in run.steps], 95)),
                    "compilation_seconds": warm.seconds - statistics.median(run.seconds for run in runs),
                    "live_device_bytes": warm.live_bytes,
                    "peak_device_bytes": most_device_bytes(jax.devices()[:1]),
                    "peak_host_bytes": peak_host_bytes(),
                }
            )
    return rows


def ratios(models: dict[str, LogVGGT], variables: Any, pictures: np.ndarray, pairs: int, lengths: list[int]) -> Any:
    """Frames a second at the longest over those at the shortest length; the two take turns."""
    short, long = min(lengths), max(lengths)
    found: dict[str, list[float]] = {mode: [] for mode in models}
    for mode, model in models.items():
        for _ in range(pairs):
            streams = ((n, open_predictor("windows", model, variables)) for n in (short, long))
            rates = [n / time_stream(stream, pictures, n).seconds for n, stream in streams]
            found[mode].append(rates[1] / rates[0])
    return {"short": short, "long": long, "ratios": found}


def transfer(pictures: np.ndarray, stride: int) -> dict[str, float]:
    """Milliseconds a frame to the device (uint8 picture) and back (depth and confidence), median of 20."""
    frames = np.ascontiguousarray(pictures[None, :stride])
    height, width = frames.shape[2:4]
    there: list[float] = []
    back: list[float] = []
    for _ in range(20):
        started = time.perf_counter()
        jax.block_until_ready(jax.device_put(frames))
        there.append(time.perf_counter() - started)
        depth = jax.block_until_ready(jnp.zeros((stride, 2, height, width)) + len(back))
        started = time.perf_counter()
        np.asarray(depth)
        back.append(time.perf_counter() - started)
    return {
        "to_device_ms": 1e3 * statistics.median(there) / stride,
        "to_host_ms": 1e3 * statistics.median(back) / stride,
    }


def by_part(model: LogVGGT, variables: Any, length: int, image_size: tuple[int, int], rounds: int) -> list[PartTime]:
    """Times of all programs of a sequence, each one alone."""
    return [time_part(part, variables, rounds=rounds) for part in sequence_parts(model, length, image_size)]


def print_tables(console: Console, report: dict[str, Any]) -> None:
    """All numbers of the report."""
    table = Table("mode", "frames", "frames/s", "first result", "step", "step, 95 %", "compilation", title="Speed")
    for row in report["speed"]:
        table.add_row(
            row["mode"],
            str(row["frames"]),
            spread(row["frames_per_second"]),
            f"{row['first_result_seconds'] * 1e3:.1f} ms",
            f"{row['step_seconds'] * 1e3:.1f} ms",
            f"{row['step_seconds_95'] * 1e3:.1f} ms",
            f"{row['compilation_seconds']:.1f} s",
        )
    console.print(table)
    table = Table("mode", "frames", "live on device", "peak on device", "peak on host", title="Memory (MiB)")
    for row in report["speed"]:
        peak = row["peak_device_bytes"]
        table.add_row(
            row["mode"],
            str(row["frames"]),
            f"{row['live_device_bytes'] / MIB:.1f}",
            "not reported by this device" if peak is None else f"{peak / MIB:.0f}",
            f"{row['peak_host_bytes'] / MIB:.0f}",
        )
    console.print(table)
    for mode, values in report["pairs"]["ratios"].items():
        short, long = report["pairs"]["short"], report["pairs"]["long"]
        console.print(
            f"{mode}: frames/s at {long} over {short}: median {spread(values)} of {len(values)} interleaved pairs"
        )
    for mode, parts in report["parts"].items():
        total = sum(part["seconds"] for part in parts)
        operations = sum(part["flops"] for part in parts)
        table = Table(
            "part",
            "time (ms)",
            "share",
            "GFLOP a frame",
            "share",
            "achieved / peak",
            "temporaries (MiB)",
            "compilation (s)",
            title=f"Parts of {report['part_frames']} frames, {mode}",
        )
        for part in parts:
            # A part that the mode does not have takes no time.
            achieved = part["flops"] / part["seconds"] / report["matmul_flops_per_second"] if part["seconds"] else None
            table.add_row(
                part["name"],
                f"{part['seconds'] * 1e3:,.1f}",
                f"{part['seconds'] / total:.2%}",
                f"{part['flops'] / report['part_frames'] / 1e9:.4f}",
                f"{part['flops'] / operations:.3%}",
                "-" if achieved is None else f"{achieved:.1%}",
                "-" if part["temporary_bytes"] is None else f"{part['temporary_bytes'] / MIB:.1f}",
                f"{part['compilation_seconds']:.1f}",
            )
        table.add_row("all", f"{total * 1e3:,.1f}", "", f"{operations / report['part_frames'] / 1e9:.4f}", style="bold")
        console.print(table)
    table = Table("mode", *(f"{n} frames" for n in report["lengths"]), "last / first", title="GFLOP a frame")
    for mode, counts in report["flops_per_frame"].items():
        values = [counts[str(n)] for n in report["lengths"]]
        table.add_row(mode, *(f"{value / 1e9:.4f}" for value in values), f"{values[-1] / values[0]:.4f}")
    console.print(table)
    rate = report["achieved_flops_per_second"]
    peak = report["matmul_flops_per_second"]
    for mode, value in rate.items():
        console.print(
            f"{mode}: {value / 1e9:.2f} GFLOP/s of {peak / 1e9:.1f} measured in matrix products, {value / peak:.1%}"
        )
    console.print(
        "host and device: {to_device_ms:.3f} ms a frame there, {to_host_ms:.3f} ms back".format(**report["transfer"])
    )


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The whole report, JSON types."""
    model, variables = subject(options)
    base, variables = model.config, jax.device_put(variables)
    context = options.context or base.windows.size
    known = {
        mode: LogVGGT(VARIANTS[variant].config(base, context=limit))
        for mode, (variant, limit) in {
            "full": ("full", None),
            "full+context": ("full", context),
            "online": ("gccr_online", None),
            "online+context": ("gccr_online", context),
        }.items()
    }
    models = {mode: known[mode] for mode in options.modes}
    lengths = sorted(options.lengths)
    pictures = random_pictures(options.image_size)
    # Counts first: they need no quiet machine, and their memory is gone before peaks are read.
    flops = {mode: {n: flops_by_part(model, n, options.image_size) for n in lengths} for mode, model in known.items()}
    rows = speed(models, variables, pictures, lengths, options.rounds)
    longest = lengths[-1]
    parts: dict[str, list[dict[str, Any]]] = {}
    for mode, model in models.items():
        times = by_part(model, variables, longest, options.image_size, options.rounds)
        parts[mode] = [
            {
                "name": name,
                "seconds": sum(t.calls * t.median for t in times if t.name == name),
                "compilation_seconds": sum(t.compilation for t in times if t.name == name),
                "temporary_bytes": max(
                    (t.temporary_bytes for t in times if t.name == name and t.temporary_bytes is not None), default=None
                ),
                "flops": flops[mode][longest][name],
            }
            for name in PARTS
        ]
    rates = {row["mode"]: statistics.median(row["frames_per_second"]) for row in rows if row["frames"] == longest}
    per_frame = {mode: {str(n): sum(c.values()) / n for n, c in counts.items()} for mode, counts in flops.items()}
    return {
        "command": shlex.join(["python", *sys.argv]),
        "device": describe_device(),
        "jax": jax.__version__,
        "model": base.to_dict(),
        "image_size": list(options.image_size),
        "context": context,
        "lengths": lengths,
        "speed": rows,
        "pairs": ratios(models, variables, pictures, options.pairs, lengths),
        "part_frames": longest,
        "parts": parts,
        "flops_per_frame": per_frame,
        "matmul_flops_per_second": matmul_flops_per_second(base.dtype),
        # Of the online mode with an unlimited trunk a stream runs less than `apply`, whose parts are counted: its
        # trunk sees the frames so far.
        "achieved_flops_per_second": {
            mode: rates[mode] * per_frame[mode][str(longest)] for mode in models if mode != "online"
        },
        "transfer": transfer(pictures, base.windows.stride),
    }


def main() -> None:
    """Measures, prints, writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_options(parser)
    parser.add_argument("--lengths", type=int, nargs="+", default=[100, 200, 500, 1000], help="frames of the streams")
    parser.add_argument(
        "--modes",
        nargs="+",
        choices=("full", "full+context", "online", "online+context"),
        default=["full", "online", "online+context"],
        help="GCCR once at the end or after every window; +context: the camera head sees --context frames, not all",
    )
    parser.add_argument("--context", type=int, help="refinement.context of the limited modes; default the window size")
    parser.add_argument("--rounds", type=int, default=3, help="streams of every length and mode")
    parser.add_argument("--pairs", type=int, default=5, help="interleaved streams of the shortest and longest length")
    parser.add_argument("--output", type=Path, default=Path("runs/efficiency"), help="folder of JSON and plot")
    options = parser.parse_args()
    console = Console()
    console.width = max(console.width, 128)
    report = measure(options)
    windows = report["model"]["windows"]
    height, width = report["image_size"]
    console.print(
        f"{report['device']}, {report['model']['dtype']}, {width} x {height} pixels, K = {windows['size']}, stride "
        f"{windows['stride']}, trunk limited to {report['context']} frames where it is, batch 1"
    )
    print_tables(console, report)
    options.output.mkdir(parents=True, exist_ok=True)
    (options.output / "efficiency.json").write_text(json.dumps(report, indent=1) + "\n")
    efficiency_plot(options.output / "efficiency.png", report)
    console.print(f"efficiency.json and efficiency.png are in {options.output}/")


if __name__ == "__main__":
    main()
