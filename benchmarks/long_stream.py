"""What a stream costs as it grows: time a frame, memory of the host, programs compiled.

    python benchmarks/long_stream.py --frames 100000                      # online, of constant size
    python benchmarks/long_stream.py --frames 20000 --mode full           # refined at the end

The model is the one that ships, or `--checkpoint`'s; frames are noise. Prints a line every so many frames. The last
thousand runs in turns with the second thousand of a stream that was begun afterwards, twenty frames each, so that a
machine that gets slower or busier slows both; what it took is also set beside the second thousand of the same stream.
`online` refines after every window with a context of a window and so many
registers (`--max_registers`, 0 for all).
"""

from __future__ import annotations

import argparse
import dataclasses
import resource
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from logvggt_jax import LogVGGT, from_pretrained
from logvggt_jax.compile import Compilations, counted_compilations
from logvggt_jax.evaluation.protocols.images import PrincipalPointCrop
from logvggt_jax.streaming import Predictor, open_predictor
from logvggt_jax.weights.checkpoints import read_provenance

PART = 1000
# Frames of one stream before it is the other's turn.
TURN = 20


class Part(NamedTuple):
    """A thousand frames: seconds by the clock, seconds of processor time, bytes of memory and programs at their end."""

    clock: float
    processor: float
    memory: int
    programs: int


class Clock:
    """Seconds by the clock and of processor time since it was last read."""

    def __init__(self) -> None:
        self._clock, self._processor = time.monotonic(), time.process_time()

    def read(self) -> np.ndarray:
        """The two since then."""
        before = self._clock, self._processor
        self._clock, self._processor = time.monotonic(), time.process_time()
        return np.subtract((self._clock, self._processor), before)


def run(
    open_stream: Callable[[], Predictor], image_size: tuple[int, int], num_frames: int, compilations: Compilations
) -> list[Part]:
    """Streams frames of noise, and prints and returns what each thousand took; the last one is timed in turns with the
    second thousand of another stream."""
    parts: list[Part] = []
    session = open_stream()
    started, clock = time.monotonic(), Clock()
    noise = np.random.default_rng(0).integers(0, 256, (16, *image_size, 3), np.uint8)

    def push(stream: Predictor, count: int) -> np.ndarray:
        clock.read()
        for index in range(count):
            stream.push(noise[index % len(noise)])
        return clock.read()

    def told(took: np.ndarray) -> None:
        parts.append(Part(*took, _resident_bytes(), compilations.count))
        if len(parts) <= 2 or len(parts) % max(num_frames // PART // 10, 1) == 0:
            print(
                f"{PART * len(parts):7,} frames: {1e3 * parts[-1].clock / PART:.2f} ms a frame, "
                f"{1e3 * parts[-1].processor / PART:.2f} ms of processor time, "
                f"{parts[-1].memory / 2**20:.0f} MiB, {compilations.count} programs",
                flush=True,
            )

    for _ in range(num_frames // PART - 1):
        told(push(session, PART))
    grown, other = _resident_bytes(), open_stream()
    push(other, PART)
    turns = [(push(session, TURN), push(other, TURN)) for _ in range(PART // TURN)]
    last, second = np.sum(turns, axis=0)
    told(last)
    parts[-1] = parts[-1]._replace(memory=grown)  # without the other stream
    print(
        f"last thousand over the second of a stream begun afterwards, in turns: {last[1] / second[1]:.3f} of processor "
        f"time, {last[0] / second[0]:.3f} by the clock"
    )
    print(f"nothing compiled after {compilations.last - started:.0f} s, of {time.monotonic() - started:.0f} s")
    clock.read()
    session.close()
    print(f"close, with what is refined at the end: {clock.read()[0]:.1f} s")
    return parts


def _resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


def main(arguments: Sequence[str] | None = None) -> None:
    """Parses, runs and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", default="rooms")
    parser.add_argument("--frames", type=int, default=10_000, help="in whole thousands, at least three")
    parser.add_argument("--mode", choices=["online", "full"], default="online")
    parser.add_argument("--max_registers", type=int, default=1024)
    options = parser.parse_args(arguments)
    model, variables = from_pretrained(options.checkpoint)
    edge = read_provenance(options.checkpoint).longer_edge or 518
    windows, refinement = model.config.windows, model.config.refinement
    if options.mode == "online":
        refinement = dataclasses.replace(
            refinement,
            period=windows.stride,
            context=windows.size,
            max_registers=options.max_registers or None,
        )
    chosen = LogVGGT(dataclasses.replace(model.config, refinement=refinement))
    size = PrincipalPointCrop(edge).size((3, 4))
    frames = max(options.frames // PART, 3) * PART
    with counted_compilations() as compilations:
        parts = run(lambda: open_predictor("windows", chosen, variables), size, frames, compilations)
    # The last thousand's memory is that at its beginning, before there was another stream.
    before_last, middle = len(parts) - 2, (len(parts) - 2) // 2
    second, half, last = parts[1], parts[middle], parts[-1]
    grown = (last.memory - half.memory) / (PART * (before_last - middle))
    print(
        f"last thousand over the second of the same stream: {last.processor / second.processor:.2f} of processor time, "
        f"{last.clock / second.clock:.2f} by the clock; {grown:.0f} bytes a frame in the second half, "
        f"{last.programs - half.programs} programs compiled in it"
    )


if __name__ == "__main__":
    main()
