"""Frames a second of rooms rendered on the host and on the device, beside those of a training step, in one run.

    python benchmarks/rooms_rendering.py
    python benchmarks/rooms_rendering.py --sizes 168x224 --clips 16 --clip-length 12 --no-step

`host` is the numpy renderer in one process and in as many as there are cores, started before the clock. `describing` is
what the host still does for pictures drawn on the device. The medians are of rounds in which host and device take
turns on the same frames. `all options` is of one clip. The step is that of configs/tiny.py, at its own size.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import jax
import numpy as np
from subject import tiny_configuration

from logvggt_jax import LogVGGT
from logvggt_jax.data import Rooms
from logvggt_jax.data.rooms.scenes import RoomScenes
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.sharding import data_mesh, put_batch
from logvggt_jax.training.step.initialization import initial_parameters
from logvggt_jax.training.step.program import make_program

HARD: dict[str, Any] = {
    "repetition": 0.5,
    "lights": 2,
    "clutter": 12,
    "rooms": 2,
    "period": 200,
    "laps": 2,
    "motion_blur": 0.5,
    "exposure": 1.0,
}


def read(rooms: Rooms, sequence: str, indices: range) -> None:
    """Renders frames on the host."""
    rooms.read(sequence, indices)


def speed(frames: int, work: Callable[[], object]) -> float:
    """Frames a second of one call of `work`, which is finished when it returns."""
    started = time.perf_counter()
    work()
    return frames / (time.perf_counter() - started)


def measure(name: str, rooms: Rooms, clips: int, clip_length: int, rounds: int, pool: ProcessPoolExecutor) -> None:
    """Prints a line for one set of rooms."""
    scenes, indices = RoomScenes(rooms), range(clip_length)
    sequences, frames = rooms.sequences[:clips], clips * clip_length

    def describe() -> dict[str, np.ndarray]:
        described = [scenes.describe(sequence, indices) for sequence in sequences]
        return {key: np.stack([each[key] for each in described]) for key in described[0]}

    batch = jax.device_put(describe())
    started = time.perf_counter()
    draw = jax.jit(scenes.draw).lower(batch).compile()
    compiled = time.perf_counter() - started
    turns: dict[str, Callable[[], object]] = {
        "host": lambda: [read(rooms, sequence, indices) for sequence in sequences],
        f"host, {os.cpu_count()} processes": lambda: list(
            pool.map(read, [rooms] * clips, sequences, [indices] * clips)
        ),
        "describing": describe,
        "device": lambda: jax.block_until_ready(draw(batch)),
    }
    for turn in turns.values():
        turn()
    speeds: dict[str, list[float]] = {turn: [] for turn in turns}
    for _ in range(rounds):
        for turn, work in turns.items():
            speeds[turn].append(speed(frames, work))
    medians = {turn: statistics.median(values) for turn, values in speeds.items()}
    numbers = ", ".join(f"{turn} {value:,.0f} frames/s" for turn, value in medians.items())
    ratio = medians["device"] / medians["host"]
    print(f"{name:14} {numbers}; device over host {ratio:.1f} x, compiled in {compiled:.0f} s", flush=True)


def training_step(clips: int, clip_length: int, rounds: int) -> None:
    """Prints the speed of the step of configs/tiny.py with such batches."""
    config = TrainConfig.from_dict(tiny_configuration())
    (height, width), *_ = config.stages[0].sizes
    mesh = data_mesh(1)
    params = initial_parameters(config.model, seed=0, weights=None)
    run = make_program(LogVGGT(config.model), config, params, mesh)
    state = run.initial_state(params)
    rooms = Rooms("train", height=height, width=width)
    scenes = RoomScenes(rooms)
    described = [scenes.describe(sequence, range(clip_length)) for sequence in rooms.sequences[:clips]]
    batch = put_batch({key: np.stack([each[key] for each in described]) for key in described[0]}, mesh)
    drawn = jax.jit(scenes.draw)(batch)
    program = run.step.lower(state, drawn).compile()
    speeds = []
    for _ in range(rounds + 1):
        started = time.perf_counter()
        state, metrics, _ = program(state, drawn)
        jax.block_until_ready(metrics)
        speeds.append(clips * clip_length / (time.perf_counter() - started))
    print(
        f"{height} x {width} training step of configs/tiny.py, {clips} clips of {clip_length}: "
        f"{statistics.median(speeds[1:]):,.0f} frames/s"
    )


def main() -> None:
    """Prints two lines a size, and one of the training step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["56x70", "168x224"], help="height x width")
    parser.add_argument("--clips", type=int, default=8)
    parser.add_argument("--clip-length", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--no-step", action="store_true", help="leave out the training step, which has to compile")
    options = parser.parse_args()
    print(
        f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores, {options.clips} clips of {options.clip_length}",
        flush=True,
    )
    # Forking a process that runs JAX's threads can deadlock.
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        for size in options.sizes:
            height, width = (int(side) for side in size.split("x"))
            # With shadows of four lamps the host takes a second for a large frame: one clip has to do.
            for name, hard, clips in (("plain", {}, options.clips), ("all options", HARD, 1)):
                rooms = Rooms("train", height=height, width=width, num_rooms=clips, **hard)
                label = f"{height} x {width} {name}"
                measure(label, rooms, clips, options.clip_length, options.rounds, pool)
    if not options.no_step:
        training_step(options.clips, options.clip_length, options.rounds)


if __name__ == "__main__":
    main()
