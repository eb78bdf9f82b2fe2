"""Compact tokens of a stream on the device, in buffers that double."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

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
    """Camera tokens, refined camera tokens and GCCR's view of the registers, of the frames that are final.

    Capacities double: a program that reads the buffers compiles anew ever more rarely, and never once a frame. What
    lies at or beyond `count` means nothing and has to be masked.

    Attributes:
      count: frames stored.
      camera: [1, capacity, 2C] float32.
      registers: GCCR's keys and values [1, capacity, 4, 2C]; None where refinement is off, which reads no registers.
      refined: [1, capacity, 2C] float32, frames that a trigger has refined.
    """

    def __init__(self, *, first_capacity: int) -> None:
        self._first_capacity = first_capacity
        self.count = 0
        self.camera: jax.Array | None = None
        self.registers: RegisterKeys | None = None
        self.refined: jax.Array | None = None

    @property
    def capacity(self) -> int:
        """Frames that fit without growing."""
        return 0 if self.camera is None else self.camera.shape[1]

    @property
    def filled_bytes(self) -> int:
        """Bytes of the frames that are stored."""
        buffers = jax.tree.leaves((self.camera, self.refined, self.registers))
        return sum(buffer.nbytes * self.count // self.capacity for buffer in buffers)

    def append(self, camera: jax.Array, registers: RegisterKeys | None, valid: int) -> None:
        """Adds the first `valid` of n frames: `camera` [1, n, 2C] and their registers' keys and values."""
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
        if frames <= self.capacity:
            return
        wanted = self._first_capacity
        while wanted < frames:
            wanted *= 2
        buffers = (self.camera, self.refined, self.registers)
        self.camera, self.refined, self.registers = _grown(buffers, room=wanted - self.capacity)

    def arrays(self) -> dict[str, np.ndarray]:
        """The stored frames and the capacity, on the host, for `restore`."""
        found = {"camera": self.camera, "refined": self.refined}
        if self.registers is not None:
            found |= {"key": self.registers.key, "value": self.registers.value}
        stored = {name: np.asarray(array[:, : self.count]) for name, array in found.items() if array is not None}
        return {**stored, "capacity": np.array([self.capacity])}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes up what `arrays` gave, in buffers of the same capacity, so that no program compiles for another."""
        placed = {name: jnp.asarray(array) for name, array in arrays.items() if name != "capacity"}
        self.camera, self.refined = placed["camera"], placed["refined"]
        if "key" in placed:
            self.registers = RegisterKeys(placed["key"], placed["value"])
        self.count = self.camera.shape[1]
        buffers = (self.camera, self.refined, self.registers)
        self.camera, self.refined, self.registers = _grown(buffers, room=int(arrays["capacity"][0]) - self.count)

    def trim(self) -> None:
        """Gives back the room beyond the last frame, in steps of the first capacity."""
        room = -(-self.count // self._first_capacity) * self._first_capacity
        buffers = (self.camera, self.refined, self.registers)
        self.camera, self.refined, self.registers = jax.tree.map(lambda x: x[:, :room], buffers)
