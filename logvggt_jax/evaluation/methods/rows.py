"""The rows of the model: LoG-VGGT, and on the same weights VGGT offline and on chunks."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.methods.method import Checkpoint, Method, model_row
from logvggt_jax.streaming import METHODS, ChunkPlan, OfflineSettings


@dataclasses.dataclass(frozen=True)
class ReferenceConfig:
    """Limits of the reference rows (`references` in configs/eval)."""

    # Longest clip that VGGT offline takes, whose memory and time grow with the square of the frames; longer ones count
    # as failed for it. None for no limit.
    max_frames: int | None = 200
    chunk_size: int = 60  # frames of a chunk
    chunk_overlap: int = 30  # frames that neighbouring chunks share

    def __post_init__(self) -> None:
        self.offline()
        self.chunks()

    def offline(self) -> OfflineSettings:
        """Of VGGT offline; InputError for impossible ones."""
        return OfflineSettings(self.max_frames)

    def chunks(self) -> ChunkPlan:
        """Of VGGT on chunks; InputError for impossible ones."""
        return ChunkPlan(self.chunk_size, self.chunk_overlap)


def model_rows(checkpoint: Checkpoint, names: Sequence[str], limits: ReferenceConfig) -> list[Method]:
    """One row for each of these methods of `logvggt_jax.streaming.METHODS`, all on the checkpoint's parameters.

    `limits` are the settings of `offline` and `chunks`; other methods have their defaults. Raises InputError for an
    unknown name.
    """
    shared = f"{limits.chunk_size} frames, {limits.chunk_overlap} shared with the next"
    known: dict[str, tuple[str, str, Any]] = {
        "windows": ("LoG-VGGT", "its training", None),
        "offline": (
            "VGGT offline",
            "its training; all frames in one window of full global attention",
            limits.offline(),
        ),
        "chunks": (
            "VGGT on chunks",
            f"its training; windows of {shared}, without memory, chained by robust similarities",
            limits.chunks(),
        ),
    }
    rows = []
    for method in names:
        if method not in METHODS:
            raise InputError(f"config.methods: unknown {method!r}; known are {', '.join(METHODS)}")
        name, knows, settings = known.get(method, (method, f"its training; {METHODS[method].summary}", None))
        rows.append(model_row(method, checkpoint, settings, name=name, knows=knows))
    return rows
