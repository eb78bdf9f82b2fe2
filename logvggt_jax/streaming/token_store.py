"""Compact tokens of a stream on the device, in buffers that grow by whole chunks."""

from __future__ import annotations

import functools
from typing import TypeVar

import jax
import jax.numpy as jnp

from logvggt_jax.model.gccr import RegisterKeys

Tokens = TypeVar("Tokens")


@functools.partial(jax.jit, donate_argnums=0)
def _write(buffers: Tokens, values: Tokens, first: jax.Array) -> Tokens:
    return jax.tree.map(
        lambda buffer, new: jax.lax.dynamic_update_slice_in_dim(buffer, new.astype(buffer.dtype), first, axis=1),
        buffers,
        values,
    )


@functools.partial(jax.jit, static_argnames="room")
def _grown(buffers: Tokens, *, room: int) -> Tokens:
    return jax.tree.map(lambda x: jnp.pad(x, [(0, room if axis == 1 else 0) for axis in range(x.ndim)]), buffers)


class TokenStore:
    """Camera tokens, register tokens and refined camera tokens of the frames that are final.

    Capacities are multiples of `chunk`, so that programs which read the buffers compile once a chunk of frames
    and not once a frame. What lies at or beyond `count` means nothing and has to be masked.

    Attributes:
      count: frames stored.
      camera: [1, capacity, 2C] float32.
      registers: register tokens [1, capacity, 4, 2C] float32, or GCCR's keys and values of them, whichever is
        appended; None where refinement is off, which reads no registers.
      refined: [1, capacity, 2C] float32, frames that a trigger has refined.
    """

    def __init__(self, *, chunk: int) -> None:
        self._chunk = chunk
        self.count = 0
        self.camera: jax.Array | None = None
        self.registers: jax.Array | RegisterKeys | None = None
        self.refined: jax.Array | None = None

    @property
    def capacity(self) -> int:
        """Frames that fit without growing."""
        return 0 if self.camera is None else self.camera.shape[1]

    def append(self, camera: jax.Array, registers: jax.Array | RegisterKeys | None, valid: int) -> None:
        """Adds the first `valid` of n frames: `camera` [1, n, 2C], `registers` [1, n, 4, 2C], of one kind always."""
        if self.camera is None:
            self.camera, self.refined = camera[:, :0], camera[:, :0]
            self.registers = jax.tree.map(lambda x: x[:, :0], registers)
        # Padded frames are written too, so that the slice keeps one shape, and overwritten by the next call.
        self.reserve(self.count + camera.shape[1])
        first = jnp.int32(self.count)
        self.camera = _write(self.camera, camera, first)
        if self.registers is not None:
            self.registers = _write(self.registers, registers, first)
        self.count += valid

    def reserve(self, frames: int) -> None:
        """Grows the buffers until `frames` frames fit; call after the first `append`."""
        room = -(-frames // self._chunk) * self._chunk - self.capacity
        if room <= 0 or self.camera is None or self.refined is None:
            return
        self.camera, self.refined = _grown(self.camera, room=room), _grown(self.refined, room=room)
        if self.registers is not None:
            self.registers = _grown(self.registers, room=room)
