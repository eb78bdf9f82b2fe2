"""What a global block may attend to besides the tokens of its own window: the seam between methods.

The aggregator hands every global block the memory of its layer and knows no method by name. Cross-window attention
(`cross_window.py`) is one memory; a key-value cache that grows, rolls or is pruned is another.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax


class Keys(NamedTuple):
    """What the queries of a block may attend to.

    Attributes:
      key: [B, N, heads, head_dim], normalised and rotated.
      value: [B, N, heads, head_dim].
      valid: which of them count: int32 [B], the first so many, or bool [B, N]; None for all.
    """

    key: jax.Array
    value: jax.Array
    valid: jax.Array | None


Project = Callable[[jax.Array], Keys]
"""Tokens [B, n · P, C] of n frames, as the residual stream has them, to their keys and values in this block: its
LayerNorm, projections, key norm and rotary embedding."""


class LayerMemory(Protocol):
    """A pytree: what one layer's global block has seen before."""

    def extend(self, own: Keys, project: Project) -> tuple[Keys, LayerMemory]:
        """The keys that the block's queries attend to, and the memory that the block leaves.

        Args:
          own: the keys of the block's own tokens.
          project: makes keys of stored tokens.
        """
        ...


class Memory(Protocol):
    """A pytree: the memories of all layers."""

    def at(self, layer: int) -> LayerMemory | None:
        """What the global block of `layer` (0-based) reads; None where it sees its own window alone."""
        ...

    def updated(self, layer: int, memory: LayerMemory) -> Memory:
        """The memory after the global block of `layer`, which left `memory`."""
        ...
