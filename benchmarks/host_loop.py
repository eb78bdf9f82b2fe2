"""What the host does for a frame of `reconstruct`, with the device's part replaced by a clock.

    python benchmarks/host_loop.py --frames 300 --device_ms 60

Writes a sequence of 640 x 480 JPEG files into a temporary folder and reconstructs it at 392 x 518 with a predictor
that hands out ready-made depth two frames at a time, as the network on a device would: a step takes as long as asked
for, begins when it is dispatched and the step before is done, and its results are fetched one step later. The time of
processors holds on a busy machine too; times by the clock need one without other work.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from logvggt_jax import LogVGGT
from logvggt_jax.geometry import encode_poses
from logvggt_jax.reconstruction import reconstruct
from logvggt_jax.streaming import METHODS, Method, WindowSettings
from logvggt_jax.streaming.results import Cameras, FrameResult, Progress, Signals, decoded_cameras
from logvggt_jax.streaming.windows import window_program

SIZE = (392, 518)
STRIDE = 2
DISTINCT = 8
MOST_FEEDING_MS, MOST_CORE_MS, MOST_OF_DEVICE = 4.0, 30.0, 1.15


class ClockPredictor:
    """Takes frames like a `StreamSession` with one window ahead, and sleeps where that would wait for the device.

    Attributes:
      seconds: by the clock, from the first frame to the last, outside of `push` and `close`.
      own_seconds: the calling thread's processor time over the same span, `push` and `close` included.
    """

    def __init__(self, step_seconds: float, depths: np.ndarray, confidences: np.ndarray) -> None:
        self._step_seconds, self._depths, self._confidences = step_seconds, depths, confidences
        self._flights: deque[tuple[float, int]] = deque()
        self._pending = self._handed_out = 0
        self._free = 0.0
        self._left: float | None = None
        self.seconds = self.own_seconds = 0.0

    @property
    def num_frames(self) -> int:
        """Frames handed out so far."""
        return self._handed_out

    def push(self, frames: Any) -> list[FrameResult]:
        """Takes one frame [H, W, 3]; the results of the step before, if one is full."""
        self._enter()
        self._pending += 1
        results = []
        if self._pending == STRIDE:
            self._dispatch()
            results = self._landed(ahead=1)
        self._left = time.perf_counter()
        return results

    def close(self, progress: Progress | None = None) -> list[FrameResult]:
        """The frames still held."""
        self._enter()
        if self._pending:
            self._dispatch()
        results = self._landed(ahead=0)
        self.own_seconds += time.thread_time()
        return results

    def snapshot(self) -> tuple[list[FrameResult], dict[str, np.ndarray]]:
        """Nothing worth saving."""
        return [], {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Nothing is ever saved."""

    def signals(self) -> Signals:
        """Nothing is known."""
        return Signals.unknown(self._handed_out)

    def cameras(self) -> Cameras:
        """A walk along x."""
        extrinsics = np.tile(np.eye(4, dtype=np.float32)[:3], (self._handed_out, 1, 1))
        extrinsics[:, 0, 3] = -0.01 * np.arange(self._handed_out)
        intrinsics = np.array([[450, 0, SIZE[1] / 2], [0, 450, SIZE[0] / 2], [0, 0, 1]], np.float32)
        encodings = encode_poses(extrinsics, np.tile(intrinsics, (self._handed_out, 1, 1)), SIZE)
        return decoded_cameras(encodings.astype(np.float32), SIZE, final=self._handed_out)

    def _enter(self) -> None:
        if self._left is None:
            self.own_seconds = -time.thread_time()
        else:
            self.seconds += time.perf_counter() - self._left

    def _dispatch(self) -> None:
        self._free = max(time.perf_counter(), self._free) + self._step_seconds
        self._flights.append((self._free, self._pending))
        self._pending = 0

    def _landed(self, *, ahead: int) -> list[FrameResult]:
        results = []
        while len(self._flights) > ahead:
            ready, count = self._flights.popleft()
            time.sleep(max(0.0, ready - time.perf_counter()))
            for index in range(self._handed_out, self._handed_out + count):
                depth, confidence = self._depths[index % DISTINCT], self._confidences[index % DISTINCT]
                results.append(FrameResult(index, depth, confidence, None, False, None, None))
            self._handed_out += count
        return results


def write_sequence(folder: Path, frames: int) -> float:
    """JPEG files of 640 x 480 whose detail falls with its frequency, as in photographs; their mean size in kB."""
    rng = np.random.default_rng(0)
    channels = np.stack([_surface(rng, (480, 640), 1.8) for _ in range(3)], axis=-1)
    noise = rng.normal(0, 1.5, (480, 640, 3))
    picture = (128 + 50 * channels + noise).clip(0, 255).astype(np.uint8)
    for index in range(frames):
        moved = np.roll(picture, 4 * index, axis=1)
        cv2.imwrite(str(folder / f"{index:06d}.jpg"), moved, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return sum(file.stat().st_size for file in folder.iterdir()) / frames / 1000


def predictions() -> tuple[np.ndarray, np.ndarray]:
    """A few depth and confidence maps [n, h, w] float32 with edges and noise."""
    rng = np.random.default_rng(1)
    surfaces = np.stack([_surface(rng, SIZE, 2.0) for _ in range(DISTINCT)])
    depths = 2 + np.round(surfaces) + 0.1 * surfaces + rng.normal(0, 0.01, surfaces.shape)
    confidences = 1 + np.exp(surfaces + rng.normal(0, 1, surfaces.shape))
    return depths.clip(0.2).astype(np.float32), confidences.astype(np.float32)


def _surface(rng: np.random.Generator, size: tuple[int, int], exponent: float) -> np.ndarray:
    """Noise [H, W] of standard deviation 1 whose amplitude falls with its frequency."""
    frequency = np.hypot(np.fft.fftfreq(size[0])[:, None], np.fft.fftfreq(size[1])) + 1.0 / max(size)
    surface = np.fft.ifft2(np.fft.fft2(rng.normal(size=size)) / frequency**exponent).real
    return surface / surface.std()


def main() -> None:
    """Prints times a frame, each beside its goal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--device_ms", type=float, default=60.0, help="of a frame")
    parser.add_argument("--workers", type=int, default=None, help="threads; default: one a core, at most eight")
    options = parser.parse_args()
    step_seconds = STRIDE * options.device_ms / 1000
    predictor = ClockPredictor(step_seconds, *predictions())
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "frames"
        folder.mkdir()
        size = write_sequence(folder, options.frames)
        print(f"{options.frames} files of 640 x 480 pixels, {size:.0f} kB each, to {SIZE[0]} x {SIZE[1]}")
        started, used = time.perf_counter(), time.process_time()
        METHODS["clock"] = Method(
            "clock", lambda *_: predictor, WindowSettings, "windows", "a clock in the device's place", window_program
        )
        result = reconstruct(
            folder,
            Path(scratch) / "out",
            model=LogVGGT(),
            variables={},
            method="clock",
            workers=options.workers,
            progress=False,
        )
        seconds, used = time.perf_counter() - started, time.process_time() - used
        assert result.num_frames == options.frames and result.seconds is not None
        device = -(-options.frames // STRIDE) * step_seconds
        print(
            f"{result.num_points:,} points; by the clock {seconds:.2f} s, {result.seconds:.2f} s of them to the last "
            "depth map"
        )
    rows = (
        ("feeding thread, its processor time", 1000 * predictor.own_seconds / options.frames, MOST_FEEDING_MS, "ms"),
        ("feeding thread, by the clock", 1000 * predictor.seconds / options.frames, MOST_FEEDING_MS, "ms"),
        ("all threads, processor time", 1000 * used / options.frames, MOST_CORE_MS, "ms"),
        (f"whole run over the device's {device:.2f} s", seconds / device, MOST_OF_DEVICE, "times"),
    )
    for name, value, goal, unit in rows:
        print(f"{name:40} {value:7.2f} {unit:5} (goal: at most {goal:g}, {value / goal:.2f} of it)")


if __name__ == "__main__":
    main()
