"""What a stream costs as it grows: time a frame, memory of the host, programs compiled.

    python benchmarks/long_stream.py --frames 100000                      # online, of constant size
    python benchmarks/long_stream.py --frames 20000 --mode full           # refined at the end

The model is the one that ships, or `--checkpoint`'s; frames are noise. Prints a line every so many frames, and at the
end the last thousand beside the second thousand, in one run. Processor time holds on a busy machine too; time by the
clock needs one without other work. `online` refines after every window with a context of a window and so many
registers (`--max_registers`, 0 for all).
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from logvggt_jax import LogVGGT, from_pretrained
from logvggt_jax.streaming import StreamSession
from logvggt_jax.weights.checkpoints import read_provenance

PART = 1000


class Part(NamedTuple):
    """A thousand frames: seconds by the clock, seconds of processor time, bytes of memory and programs at their end."""

    clock: float
    processor: float
    memory: int
    programs: int


class Compilations:
    """Counts the programs that JAX compiles, and when it last did."""

    def __init__(self) -> None:
        self.count, self.last = 0, 0.0
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def _heard(self, name: str, seconds: float, **_: object) -> None:
        if name.endswith("backend_compile_duration"):
            self.count, self.last = self.count + 1, time.monotonic()


def run(session: StreamSession, image_size: tuple[int, int], num_frames: int) -> list[Part]:
    """Streams frames of noise, and prints and returns what each thousand took."""
    compilations, parts = Compilations(), []
    started = clock = time.monotonic()
    processor = time.process_time()
    noise = np.random.default_rng(0).integers(0, 256, (16, *image_size, 3), np.uint8)
    for index in range(num_frames):
        session.push(noise[index % len(noise)])
        if (index + 1) % PART:
            continue
        now, used = time.monotonic(), time.process_time()
        parts.append(Part(now - clock, used - processor, _resident_bytes(), compilations.count))
        clock, processor = now, used
        if len(parts) <= 2 or len(parts) % max(num_frames // PART // 10, 1) == 0:
            print(
                f"{index + 1:7,} frames: {1e3 * parts[-1].clock / PART:.2f} ms a frame, "
                f"{1e3 * parts[-1].processor / PART:.2f} ms of processor time, "
                f"{parts[-1].memory / 2**20:.0f} MiB, {compilations.count} programs",
                flush=True,
            )
    print(f"nothing compiled after {compilations.last - started:.0f} s, of {time.monotonic() - started:.0f} s")
    clock = time.monotonic()
    session.close()
    print(f"close, with what is refined at the end: {time.monotonic() - clock:.1f} s")
    return parts


def _resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


def main(arguments: Sequence[str] | None = None) -> None:
    """Parses, runs and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", default="rooms")
    parser.add_argument("--frames", type=int, default=10_000)
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
    session = StreamSession(LogVGGT(dataclasses.replace(model.config, refinement=refinement)), variables)
    parts = run(session, (edge * 3 // 4 // 14 * 14, edge), options.frames)
    if len(parts) < 3:
        return
    second, half, last = parts[1], parts[len(parts) // 2], parts[-1]
    grown = (last.memory - half.memory) / (PART * (len(parts) - 1 - len(parts) // 2))
    print(
        f"last thousand over second: {last.processor / second.processor:.2f} of processor time, "
        f"{last.clock / second.clock:.2f} by the clock; {grown:.0f} bytes a frame in the second half, "
        f"{last.programs - half.programs} programs compiled in it"
    )


if __name__ == "__main__":
    main()
