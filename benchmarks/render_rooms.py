"""Frames a second of the ray caster that renders procedural rooms, in one process and in several.

    python benchmarks/render_rooms.py
    python benchmarks/render_rooms.py --size 56x70 --processes 4

Both turns render the same rooms; worker processes are started before the clock.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor

from logvggt_jax.data import Rooms


def render(rooms: Rooms, sequence: str) -> int:
    """Renders a room; the number of its frames."""
    return len(rooms.read(sequence, range(rooms.num_frames(sequence))).images)


def main() -> None:
    """Prints a line a turn, the last one with the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="96x128", help="height x width")
    parser.add_argument("--rooms", type=int, default=8)
    parser.add_argument("--frames", type=int, default=48, help="frames a room")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    height, width = (int(side) for side in options.size.split("x"))
    rooms = Rooms("train", height=height, width=width, num_rooms=options.rooms, num_frames=options.frames)
    speeds = []
    for processes in (1, options.processes):
        with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as executor:
            list(executor.map(render, [rooms] * processes, rooms.sequences[:processes]))  # imports, caches
            started = time.perf_counter()
            frames = sum(executor.map(render, [rooms] * options.rooms, rooms.sequences))
            speeds.append(frames / (time.perf_counter() - started))
        ratio = f", {speeds[-1] / speeds[0]:.2f} x one process" if len(speeds) > 1 else ""
        print(f"{height} x {width}, {processes} process(es): {speeds[-1]:.0f} frames/s{ratio}")


if __name__ == "__main__":
    main()
