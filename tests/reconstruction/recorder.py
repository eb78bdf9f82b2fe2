"""A method that stands in for the model, for tests of what is around it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from logvggt_jax import LogVGGT
from logvggt_jax.reconstruction import Reconstruction, Source, reconstruct
from logvggt_jax.streaming import METHODS, Cameras, FrameResult, Method, Predictor, Progress, Signals, WindowSettings
from logvggt_jax.streaming.results import decoded_cameras
from logvggt_jax.streaming.windows import window_program

LONGER_EDGE = 42


class Recorder:
    """A predictor of two frames at a time whose depth follows from the frames' numbers alone; calls `on_push` at each
    frame with their number."""

    def __init__(self, on_push: Callable[[int], object] = lambda _: None) -> None:
        self.on_push, self.num_pushed = on_push, 0
        self.frames: list[np.ndarray] = []
        self.masks: list[np.ndarray | None] = []
        self.threads: set[int] = set()
        self.num_frames = 0

    def push(self, frame: np.ndarray, mask: np.ndarray | None = None) -> list[FrameResult]:
        self.num_pushed += 1
        self.masks.append(mask)
        self.on_push(self.num_pushed)
        self.threads.add(threading.get_ident())
        self.frames.append(frame)
        return self.close() if len(self.frames) == 2 else []

    def close(self, progress: Progress | None = None) -> list[FrameResult]:
        results = []
        for frame in self.frames:
            generator = np.random.default_rng(self.num_frames)
            depth = generator.uniform(1, 1.2, frame.shape[:2]).astype(np.float32)
            results.append(FrameResult(self.num_frames, depth, 1 + depth**9, None, False, None, None))
            self.num_frames += 1
        self.frames = []
        return results

    def snapshot(self) -> tuple[list[FrameResult], dict[str, np.ndarray]]:
        frames = {"frames": np.stack(self.frames)} if self.frames else {}
        return [], {"num_frames": np.array([self.num_frames]), **frames}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.num_frames = int(arrays["num_frames"][0])
        self.frames = list(arrays.get("frames", ()))

    def cameras(self, *, provisional: bool = False) -> Cameras:
        encodings = np.tile(np.array([0, 0, 0, 0, 0, 0, 1, 1, 1.2], np.float32), (self.num_frames, 1))
        encodings[:, 0] = np.arange(self.num_frames)
        return decoded_cameras(encodings, (28, 42), final=self.num_frames)

    def signals(self) -> Signals:
        return Signals.unknown(self.num_frames)


def reconstruct_recorded(
    predictor: Predictor, source: Source | Path, output: Path, *, takes_masks: bool = False, **options: Any
) -> Reconstruction:
    """A reconstruction by a method whose predictor this is, with one preview: they take most of a small run's time."""
    with pytest.MonkeyPatch.context() as patch:
        facts = ("windows", "records", window_program, takes_masks)
        method = Method("recorder", lambda *_: predictor, WindowSettings, *facts)
        patch.setitem(METHODS, "recorder", method)
        return reconstruct(
            source,
            output,
            model=LogVGGT(),
            method="recorder",
            **{"longer_edge": LONGER_EDGE, "variables": {}, "num_previews": 1, **options},
        )
