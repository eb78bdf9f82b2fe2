"""InfiniteVGGT: a causal stream whose caches stay within a budget; see `model/rolling_cache.py` for what goes.

Whatever a stream has learned of its sequence belongs to it and ends with it. In the original, scores and the anchor's
length stay on the network's modules, and the next sequence starts with them.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.config import ModelConfig, require_counts, require_one_of, require_within
from logvggt_jax.model.key_value_cache import GrowingCache, empty
from logvggt_jax.model.memory import Memory
from logvggt_jax.model.padding import doubled
from logvggt_jax.model.rolling_cache import RollingCache, RollingMemory
from logvggt_jax.streaming.causal import CAMERA_CACHES
from logvggt_jax.streaming.frame_session import (
    CAMERA_CAPACITY,
    StreamMemory,
    block_shape,
    camera_memory,
    camera_with_room,
    with_room,
)
from logvggt_jax.streaming.results import PredictionError

# Places of a layer's cache over its equal share of the budget: layers that resemble themselves less get more, in the
# extreme e^(1 / temperature) times as much as others, for which few would make room.
_HEADROOM = 2.0


@dataclasses.dataclass(frozen=True)
class RollingSettings:
    """Settings of a rolling memory; the defaults are InfiniteVGGT's.

    Attributes:
      budget: tokens a head, in all layers together. At most 2³¹ − 1.
      temperature: of the softmax that shares the budget among the layers.
      anchor: first frames that always stay.
      camera_cache: see `CausalSettings`. These caches are small and never lose an entry.
      ahead: frames that may be on the device when `push` returns, see `FrameSession`.
      first_capacity: frames that the caches hold at first, where the budget is not less. They double up to twice a
        layer's equal share of the budget, and beyond it only for a layer whose budget asks for more.
    """

    budget: int = 1_200_000
    temperature: float = 0.5
    anchor: int = 1
    camera_cache: Literal["per_round", "single"] = "per_round"
    ahead: int = 1
    first_capacity: int = 64

    def __post_init__(self) -> None:
        require_one_of(self, CAMERA_CACHES, "camera_cache")
        require_counts(self, "budget", "first_capacity")
        require_within(self, "[1, 2147483647]", "budget", "first_capacity")
        # Scores over less leave the numbers of float32.
        require_within(self, "[1e-6, inf)", "temperature")
        require_counts(self, "anchor", "ahead", least=0)


class KeepWithinBudget:
    """Caches of the global blocks within a budget, and all entries of the camera's."""

    def __init__(self, settings: RollingSettings, rounds: int) -> None:
        self._settings, self._rounds = settings, rounds
        # No layer holds more than so many tokens; None before the device is asked.
        self._at_most: int | None = None

    def start(self, config: ModelConfig, tokens: int, frames: int = 1) -> StreamMemory:
        """Empty caches. Raises PredictionError for a budget that is below the anchor, or one frame, in every layer."""
        settings, depth = self._settings, config.aggregator.depth
        least = max(1, settings.anchor) * tokens
        if settings.budget < depth * least:
            raise PredictionError(
                f"RollingSettings.budget: {settings.budget} tokens leave {settings.budget // depth} to each of {depth} "
                f"layers, fewer than the {least} of {least // tokens} frame(s) of this size; take at least "
                f"{depth * least}"
            )
        capacity = min(doubled(settings.first_capacity, frames) * tokens, self._usual(depth) + tokens)
        anchor = settings.anchor * tokens

        def layer() -> RollingCache:
            cache = empty(GrowingCache, block_shape(config, capacity), config.dtype)
            nothing = (jnp.zeros((), jnp.int32), jnp.zeros((), jnp.float32))
            return RollingCache(cache.key, cache.value, cache.length, *nothing, anchor)

        layers = tuple(layer() for _ in range(depth))
        blocks = RollingMemory(layers, jnp.zeros(depth, jnp.float32), settings.budget, settings.temperature)
        per_round = settings.camera_cache == "per_round"
        return StreamMemory(blocks, camera_memory(config, GrowingCache, CAMERA_CAPACITY, per_round=per_round))

    def make_room(self, memory: StreamMemory, tokens: int, received: int) -> StreamMemory:
        """Room for one more frame; asks the device for the caches' lengths where they may be full."""
        blocks = memory.blocks
        assert isinstance(blocks, RollingMemory)  # from `start`
        capacity = blocks.layers[0].capacity
        if self._at_most is None or self._at_most + tokens > capacity:
            self._at_most = int(np.max(jax.device_get([layer.length for layer in blocks.layers])))
        self._at_most += tokens
        depth, kept = len(blocks.layers), self._at_most - tokens
        limit = self._usual(depth) if kept <= self._usual(depth) else self._largest(depth)
        grown: Memory = with_room(blocks, self._at_most, at_most=limit + tokens)
        return StreamMemory(grown, camera_with_room(memory.camera, received, self._rounds))

    def _usual(self, depth: int) -> int:
        """Tokens of a layer's cache between frames that serve a sequence from end to end, but for rare ones."""
        return min(int(_HEADROOM * self._settings.budget / depth), self._largest(depth))

    def _largest(self, depth: int) -> int:
        """The largest budget that a layer can get: with a score of 0 where all others have 1."""
        return int(self._settings.budget / (1 + (depth - 1) * math.exp(-1 / self._settings.temperature))) + 1
