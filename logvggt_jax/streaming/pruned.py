"""XStreamVGGT: a causal stream whose caches keep what the newest frame looks for, in four bits; see
`model/pruned_cache.py` for what goes."""

from __future__ import annotations

import dataclasses
from typing import Literal

from logvggt_jax.config import ModelConfig, require_counts, require_one_of, require_within
from logvggt_jax.model.key_value_cache import AnchoredCache, Caches, CameraMemory, empty
from logvggt_jax.model.memory import RoundMemory
from logvggt_jax.model.padding import doubled
from logvggt_jax.model.pruned_cache import PrunedCache, empty_packed
from logvggt_jax.streaming.causal import CAMERA_CACHES
from logvggt_jax.streaming.frame_session import (
    CAMERA_CAPACITY,
    StreamMemory,
    block_shape,
    with_room,
)
from logvggt_jax.streaming.results import PredictionError


@dataclasses.dataclass(frozen=True)
class PrunedSettings:
    """Settings of a pruned memory; the defaults are those of XStreamVGGT's published runs.

    Attributes:
      cap: tokens that a cache keeps, at least two frames whatever it says. The camera head's caches, of one entry a
        frame (and round), have the same cap.
      bits: 4, packed; or 16, as the compute type has them. The camera head's caches are never coded.
      camera_cache: see `CausalSettings`.
      ahead: frames that may be on the device when `push` returns, see `FrameSession`.
      first_capacity: frames that the caches hold at first, where the cap is not less; they double up to it.
    """

    cap: int = 2048
    bits: Literal[4, 16] = 4
    camera_cache: Literal["per_round", "single"] = "per_round"
    ahead: int = 1
    first_capacity: int = 16

    def __post_init__(self) -> None:
        require_one_of(self, (4, 16), "bits")
        require_one_of(self, CAMERA_CACHES, "camera_cache")
        require_counts(self, "cap", "first_capacity")
        require_within(self, "[1, 2147483647]", "first_capacity")
        require_counts(self, "ahead", least=0)


@dataclasses.dataclass(frozen=True)
class KeepWanted:
    """Caches up to a cap, in which the camera's registers are those of as many frames as fit it, the first and the
    newest."""

    settings: PrunedSettings
    rounds: int

    def start(self, config: ModelConfig, tokens: int, frames: int = 1) -> StreamMemory:
        """Empty caches. Raises PredictionError for a cap below one frame."""
        settings = self.settings
        if settings.cap < tokens:
            raise PredictionError(
                f"PrunedSettings.cap: {settings.cap} tokens are fewer than the {tokens} of a frame of this size; take "
                f"at least {tokens}, or {2 * tokens} for the first frame and the newest"
            )
        capacity = min(doubled(settings.first_capacity, frames) * tokens, self._most(tokens))
        shape, special = block_shape(config, capacity), config.aggregator.num_special

        def layer() -> PrunedCache:
            if settings.bits == 4:
                return empty_packed(shape, special=special, tokens=tokens)
            return empty(PrunedCache, shape, config.dtype, special=special)

        blocks = Caches(tuple(layer() for _ in range(config.aggregator.depth)))
        return StreamMemory(blocks, self._camera(config, tokens))

    def make_room(self, memory: StreamMemory, tokens: int, received: int) -> StreamMemory:
        """Room for one more frame, or for the cap."""

        def room(entries: int, most: int) -> dict[str, int]:
            return {"entries": min(entries, most), "at_most": most}

        frames, trunk = received + 1, memory.camera.trunk
        blocks = with_room(memory.blocks, **room(frames * tokens, self._most(tokens)))
        each = with_room(trunk.each, **room(frames, self._most(1)))
        shared = with_room(trunk.shared, **room(frames * self.rounds, self._most(1)))
        registers = with_room(memory.camera.registers, **room(frames, self._most(tokens) // tokens))
        return StreamMemory(blocks, CameraMemory(RoundMemory(each, shared), registers))

    def _most(self, tokens: int) -> int:
        """Tokens that a cache keeps of frames of so many."""
        return max(self.settings.cap, 2 * tokens)

    def _camera(self, config: ModelConfig, tokens: int) -> CameraMemory:
        head, width = config.camera_head, 2 * config.encoder.embed_dim
        per_round = self.settings.camera_cache == "per_round"
        entries = min(CAMERA_CAPACITY * (1 if per_round else self.rounds), self._most(1))
        shape, rounds = (1, entries, head.num_heads, width // head.num_heads), self.rounds if per_round else None
        trunk = Caches(tuple(empty(PrunedCache, shape, rounds=rounds, special=1) for _ in range(head.depth)))
        registers = None
        if config.refinement.enabled:
            frames = min(CAMERA_CAPACITY, self._most(tokens) // tokens)
            registers = empty(AnchoredCache, (1, frames, config.aggregator.num_registers, width), config.dtype)
        return CameraMemory(RoundMemory(each=trunk) if per_round else RoundMemory(shared=trunk), registers)
