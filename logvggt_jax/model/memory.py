"""What a block may attend to besides the tokens of its own window: the seam between methods.

The aggregator hands every global block the memory of its layer, the camera head every block of its trunk, and neither
knows a method by name. Cross-window attention (`cross_window.py`) is one memory; a key-value cache that grows, rolls or
is pruned is another, and so is a mask or a merging of the block's own tokens, which remembers nothing.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct


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


class OwnTokens(NamedTuple):
    """A block's own tokens on their way into its attention.

    Attributes:
      normed: [B, N, C] float32, after the block's LayerNorm.
      query: [B, N, heads, head_dim], normalised and rotated.
      keys: of the same tokens; `valid` says which of them count.
    """

    normed: jax.Array
    query: jax.Array
    keys: Keys


Attend = Callable[[jax.Array, Keys], jax.Array]
"""Queries [B, Q, heads, head_dim] and the keys that all of them see, to [B, Q, heads, head_dim]. It has no parameters
and may stand in loops."""

Project = Callable[[jax.Array], Keys]
"""Tokens [B, n · P, C] of n frames, as the residual stream has them, to their keys and values in this block: its
LayerNorm, projections, key norm and rotary embedding."""


class LayerMemory(Protocol):
    """A pytree: what one block has seen before, and how its tokens attend to it."""

    def attend(self, own: OwnTokens, attention: Attend, project: Project) -> tuple[jax.Array, LayerMemory]:
        """What the block's N tokens take in, [B, N, heads, head_dim], and the memory that the block leaves.

        Args:
          own: the block's own tokens.
          attention: the block's attention, of queries to keys.
          project: makes keys of tokens that are stored as the residual stream has them.
        """
        ...


class Memory(Protocol):
    """A pytree: the memories of all layers of a stack of blocks."""

    def at(self, layer: int) -> LayerMemory | None:
        """What the block of `layer` (0-based) reads; None where it sees its own tokens alone."""
        ...

    def updated(self, layer: int, memory: LayerMemory) -> Memory:
        """The memory after the block of `layer`, which left `memory`."""
        ...


class FixedMemory(abc.ABC):
    """A memory that blocks read and leave as it is, of the same form at all layers that read it: all layers may run as
    one loop, see `in_loop`."""

    @abc.abstractmethod
    def at(self, layer: int) -> LayerMemory | None:
        """What the block of `layer` (0-based) reads; None where it sees its own tokens alone."""

    def updated(self, layer: int, memory: LayerMemory) -> Self:
        """The same."""
        del layer, memory
        return self


def in_loop(memory: FixedMemory | None, depth: int) -> tuple[Any, Callable[[Any], LayerMemory | None]]:
    """A memory for `depth` layers that run as one loop: a pytree with a row for each of them, over which the loop runs,
    and the function that makes of a layer's row what its block reads."""
    reads = [None if memory is None else memory.at(layer) for layer in range(depth)]
    there = [read for read in reads if read is not None]
    if not there:
        return None, lambda row: None
    stored = jax.tree.map(lambda *read: jnp.stack(read), *there)
    if len(there) == depth:
        return stored, lambda row: row
    is_there = np.array([read is not None for read in reads])
    return (np.cumsum(is_there) - is_there, is_there), lambda row: _OfSomeLayers(stored, *row)


@struct.dataclass
class _OfSomeLayers:
    """What the block of one layer reads in a loop of which some layers alone read anything.

    Attributes:
      stored: what those layers read, with a leading axis of them.
      place: int32, the layer's place among them.
      is_there: bool, whether the layer is one of them.
    """

    stored: LayerMemory
    place: jax.Array
    is_there: jax.Array

    def attend(self, own: OwnTokens, attention: Attend, project: Project) -> tuple[jax.Array, LayerMemory]:
        """Takes the layer's memory out where it is read, so that other layers have no work with it."""

        def with_memory() -> jax.Array:
            read: LayerMemory = jax.tree.map(lambda x: x[self.place], self.stored)
            return read.attend(own, attention, project)[0]

        return jax.lax.cond(self.is_there, with_memory, lambda: attention(own.query, own.keys)), self


class RoundMemory(NamedTuple):
    """What the camera head's trunk remembers, over its R rounds of correction; one of the two is None.

    Attributes:
      each: a memory for each round, every leaf with a leading axis of R: a round sees what the same round has left.
      shared: one memory that all rounds read and write one after the other.
    """

    each: Memory | None = None
    shared: Memory | None = None
