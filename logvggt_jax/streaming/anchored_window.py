"""STream3R's window mode: every frame attends to the first frame and to the newest few, itself among them.

The caches are as large as that from the first frame on: the cheapest method of bounded cost. STream3R's own cache lets
a frame see one frame more than its mask does; here both see what the mask form sees.
"""

from __future__ import annotations

import dataclasses

from logvggt_jax.config import ModelConfig, require_counts, require_within
from logvggt_jax.model.key_value_cache import AnchoredCache, Caches, empty
from logvggt_jax.streaming.frame_session import StreamMemory, block_shape, camera_memory


@dataclasses.dataclass(frozen=True)
class AnchoredWindowSettings:
    """Settings of an anchored window.

    Attributes:
      window: newest frames that a frame sees besides the first, itself among them.
      ahead: frames that may be on the device when `push` returns, see `FrameSession`.
    """

    window: int = 5
    ahead: int = 1

    def __post_init__(self) -> None:
        require_counts(self, "window")
        require_within(self, "[1, 2147483647]", "window")
        require_counts(self, "ahead", least=0)


@dataclasses.dataclass(frozen=True)
class KeepWindow:
    """Caches of the first frame and the newest ones, those of camera head and GCCR too."""

    window: int

    def start(self, config: ModelConfig, tokens: int, frames: int = 1) -> StreamMemory:
        """Empty caches, as large as they will ever be."""
        del frames
        kept = 1 + self.window
        shape = block_shape(config, kept * tokens)
        blocks = Caches(tuple(empty(AnchoredCache, shape, config.dtype) for _ in range(config.aggregator.depth)))
        return StreamMemory(blocks, camera_memory(config, AnchoredCache, kept))

    def make_room(self, memory: StreamMemory, tokens: int, received: int) -> StreamMemory:
        """The same: a new frame takes the place of an old one."""
        del tokens, received
        return memory
