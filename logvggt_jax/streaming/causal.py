"""StreamVGGT: every frame attends to itself and to all frames before it, through a cache of all their keys and values.

Nothing is ever forgotten: memory and the time of a frame grow with the sequence.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

from logvggt_jax.config import ModelConfig, require_counts, require_one_of, require_within
from logvggt_jax.model.key_value_cache import Caches, GrowingCache, empty
from logvggt_jax.model.padding import doubled
from logvggt_jax.streaming.frame_session import (
    CAMERA_CAPACITY,
    StreamMemory,
    block_shape,
    camera_memory,
    camera_with_room,
    with_room,
)

CAMERA_CACHES = ("per_round", "single")


@dataclasses.dataclass(frozen=True)
class CausalSettings:
    """Settings of a causal stream.

    Attributes:
      camera_cache: `per_round`, every round of the camera head remembers what the same round saw of earlier frames, as
        in training under a causal mask; or `single`, all rounds fill one cache one after the other, as StreamVGGT's and
        InfiniteVGGT's published inference does, for weights that were trained so.
      ahead: frames that may be on the device when `push` returns, see `FrameSession`.
      first_capacity: frames that the caches hold at first; they double.
    """

    camera_cache: Literal["per_round", "single"] = "per_round"
    ahead: int = 1
    first_capacity: int = 16

    def __post_init__(self) -> None:
        require_one_of(self, CAMERA_CACHES, "camera_cache")
        require_counts(self, "first_capacity")
        require_within(self, "[1, 2147483647]", "first_capacity")
        require_counts(self, "ahead", least=0)


@dataclasses.dataclass(frozen=True)
class KeepAll:
    """Caches of all frames."""

    settings: CausalSettings
    rounds: int

    def start(self, config: ModelConfig, tokens: int, frames: int = 1) -> StreamMemory:
        """Empty caches of `first_capacity` frames, doubled until so many fit."""
        shape = block_shape(config, doubled(self.settings.first_capacity, frames) * tokens)
        blocks = Caches(tuple(empty(GrowingCache, shape, config.dtype) for _ in range(config.aggregator.depth)))
        per_round = self.settings.camera_cache == "per_round"
        return StreamMemory(blocks, camera_memory(config, GrowingCache, CAMERA_CAPACITY, per_round=per_round))

    def make_room(self, memory: StreamMemory, tokens: int, received: int) -> StreamMemory:
        """Room for one more frame."""
        blocks = with_room(memory.blocks, (received + 1) * tokens)
        return StreamMemory(blocks, camera_with_room(memory.camera, received, self.rounds))
