"""Methods whose results are known beforehand, and evaluations of small rooms with them."""

import dataclasses
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.evaluation.clips import ClipData
from logvggt_jax.evaluation.methods.baselines import static_camera
from logvggt_jax.evaluation.methods.method import ClipPrediction, Method
from logvggt_jax.evaluation.plan import Benchmark
from logvggt_jax.evaluation.protocols.clips import ClipSettings, clip_protocols
from logvggt_jax.evaluation.runner import evaluate
from logvggt_jax.geometry import compose
from logvggt_jax.types import Frames

SIZE = (28, 42)
SETTINGS = ClipSettings(image_size=SIZE, clip_lengths=(4, 6), stride=2, max_points=1500, figures=0)


def oracle(frames: Frames, change: Callable[[ClipPrediction], ClipPrediction] = lambda p: p) -> Method:
    """Recognises each image and answers with its truth in half the unit, in another world."""
    move = np.eye(4)
    move[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    move[:3, 3] = [3.0, -2.0, 1.0]
    known = {image.tobytes(): t for t, image in enumerate(frames.images)}

    def predict(images: np.ndarray) -> ClipPrediction:
        chosen = [known[image.tobytes()] for image in images]
        extrinsics = compose(frames.extrinsics[chosen].astype(np.float64), move)
        extrinsics[:, :3, 3] *= 0.5
        return change(ClipPrediction(0.5 * frames.depth[chosen], extrinsics, frames.intrinsics[chosen]))

    return Method("oracle", "everything", predict)


def all_frames(rooms: Rooms) -> Frames:
    parts = [rooms.read(name, range(rooms.num_frames(name))) for name in rooms.sequences]
    arrays = [np.concatenate([getattr(part, field) for part in parts]) for field in Frames._fields[:4]]
    return Frames(*arrays, metric=True)


def clip_of(frames: Frames) -> ClipData:
    return ClipData(frames.images, frames.depth, frames.intrinsics, frames.extrinsics)


def benchmarks_of(dataset: Any, settings: ClipSettings = SETTINGS) -> list[Benchmark]:
    return [Benchmark(protocol, dataset, "test") for protocol in clip_protocols("rooms", "test", settings, SIZE)]


def run(
    dataset: Any, methods: Sequence[Method], output: Path, settings: ClipSettings = SETTINGS, **options: Any
) -> dict[str, Any]:
    """Evaluates methods on clips of a data set, silently."""
    return evaluate(
        benchmarks_of(dataset, settings),
        methods,
        output,
        title="rooms",
        command="command",
        configuration=dataclasses.asdict(settings),
        max_sequences=settings.max_sequences,
        figures=settings.figures,
        console=Console(file=io.StringIO()),
        **options,
    )


def failing(message: str, *, at_call: int, error: type[Exception] = RuntimeError) -> tuple[Method, list[int]]:
    """A camera that stands still and raises once, and the lengths of the clips it was called for."""
    calls: list[int] = []

    def predict(images: np.ndarray) -> ClipPrediction:
        calls.append(len(images))
        if len(calls) == at_call:
            raise error(message)
        return static_camera().predict(images)

    return dataclasses.replace(static_camera(), predict=predict), calls
