"""Compact tokens of a stream on the device: all of them in buffers that double, or what is still read in fixed ones."""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.model.gccr import RegisterKeys
from logvggt_jax.model.kept_registers import is_kept
from logvggt_jax.model.padding import doubled, with_places

Tokens = TypeVar("Tokens")


@functools.partial(jax.jit, donate_argnums=0)
def _write(buffers: Tokens, values: Tokens, first: jax.Array) -> Tokens:
    return jax.tree.map(
        lambda buffer, new: jax.lax.dynamic_update_slice_in_dim(buffer, new.astype(buffer.dtype), first, axis=1),
        buffers,
        values,
    )


@functools.partial(jax.jit, donate_argnums=0)
def _place(buffers: Tokens, values: Tokens, places: jax.Array) -> Tokens:
    """Values at their places; what has a place beyond the end is dropped."""
    return jax.tree.map(lambda buffer, new: buffer.at[:, places].set(new, mode="drop"), buffers, values)


@functools.partial(jax.jit, donate_argnums=0)
def _slide(buffers: Tokens, frames: jax.Array) -> Tokens:
    """Forgets the `frames` after the first one."""

    def slid(buffer: jax.Array) -> jax.Array:
        room = buffer.shape[1]
        padded = with_places(buffer, room, axis=1)
        rest = jax.lax.dynamic_slice_in_dim(padded, 1 + frames, room - 1, axis=1)
        return jnp.concatenate([buffer[:, :1], rest], axis=1)

    return jax.tree.map(slid, buffers)


@functools.partial(jax.jit, static_argnames="room")
def _grown(buffers: Tokens, *, room: int) -> Tokens:
    return jax.tree.map(lambda x: with_places(x, room, axis=1), buffers)


class _Waiting(NamedTuple):
    """Registers of a window's frames, from `first` on, that have not all been given a slot."""

    registers: RegisterKeys
    first: int
    valid: int


class TokenStore:
    """Camera tokens, refined camera tokens and GCCR's view of the registers, of the frames that are final.

    Where everything may be read again, capacities double: a program that reads the buffers compiles anew ever more
    rarely, and never once a frame. Where a stream reads its newest frames alone, camera tokens live in buffers of one
    size: the first frame, and after it the newest ones. A bounded number of registers has slots of its own. What lies
    at or beyond `count` means nothing and has to be masked.

    Args:
      first_capacity: frames that fit at first.
      reach: newest frames whose camera tokens are read again, besides the first one's; None for all.
      max_frames: frames whose registers are kept, see `is_kept`; None for all.

    Attributes:
      count: frames stored.
      camera: [1, capacity, 2C] float32; frame f > 0 is at `position(f)`.
      refined: [1, capacity, 2C] float32, frames that a trigger has refined, at the same places.
      registers: GCCR's keys and values [1, capacity or max_frames, 4, 2C]; None where refinement is off, which reads
        no registers.
    """

    def __init__(self, *, first_capacity: int, reach: int | None = None, max_frames: int | None = None) -> None:
        self._first_capacity = first_capacity if reach is None else max(first_capacity, 2 * reach + 1)
        self._reach, self._max_frames = reach, max_frames
        self.count = 0
        self.camera: jax.Array | None = None
        self.registers: RegisterKeys | None = None
        self.refined: jax.Array | None = None
        self._forgotten = 0  # frames after the first one
        self._slots = np.full(max_frames or 0, -1, np.int64)  # the frame of each slot
        self._admitted = 0
        self._waiting: _Waiting | None = None

    @property
    def capacity(self) -> int:
        """Frames that fit without growing."""
        return 0 if self.camera is None else self.camera.shape[1]

    @property
    def keeps_all(self) -> bool:
        """Whether every frame's tokens are here."""
        return self._reach is None and self._max_frames is None

    def position(self, frame: int) -> int:
        """Where a frame's tokens are, or will be, in `camera` and `refined`."""
        return frame - self._forgotten

    @property
    def filled_bytes(self) -> int:
        """Bytes of the frames that are stored."""
        if self.camera is None:
            return 0
        tokens = 2 * self.camera.nbytes * self.position(self.count) // self.capacity
        kept = self.count if self._max_frames is None else int((self._slots >= 0).sum())
        return tokens + sum(x.nbytes * kept // x.shape[1] for x in jax.tree.leaves(self.registers))

    def append(self, camera: jax.Array, registers: RegisterKeys | None, valid: int) -> None:
        """Adds the first `valid` of n frames: `camera` [1, n, 2C] and their registers' keys and values."""
        if self.camera is None:
            self.camera, self.refined = camera[:, :0], camera[:, :0]
            room = 0 if self._max_frames is None else self._max_frames
            self.registers = jax.tree.map(lambda x: jnp.zeros((1, room, *x.shape[2:]), x.dtype), registers)
        # Padded frames are written too, so that the slice keeps one shape, and overwritten by the next call.
        self.reserve(self.count + camera.shape[1])
        self.camera = _write(self.camera, camera, jnp.int32(self.position(self.count)))
        if self._max_frames is not None:
            self._admit(self.count)
            self._waiting = None if registers is None else _Waiting(registers, self.count, valid)
        elif self.registers is not None:
            self.registers = _write(self.registers, registers, jnp.int32(self.count))
        self.count += valid

    def registers_at(self, stop: int) -> tuple[RegisterKeys | None, jax.Array]:
        """What GCCR reads once `stop` frames are there, and which of it counts, as `Span.seen`.

        `stop` never falls: a bounded store forgets what no later call asks for.
        """
        if self._max_frames is None or self.registers is None:
            return self.registers, jnp.full(1, stop, jnp.int32)
        self._admit(stop)
        return self.registers, jnp.asarray(self._slots >= 0)[None]

    def _admit(self, stop: int) -> None:
        """Gives slots to the waiting frames before `stop`, those of frames that are then no longer kept."""
        if self._waiting is None:
            return
        registers, first, valid = self._waiting
        stop = min(stop, first + valid)
        if stop <= self._admitted:
            return
        assert self._max_frames is not None
        count, new = np.array(stop), np.arange(self._admitted, stop)
        self._slots[~is_kept(self._slots, count, self._max_frames)] = -1
        new = new[is_kept(new, count, self._max_frames)]
        free = np.flatnonzero(self._slots < 0)[: len(new)]
        self._slots[free] = new
        places = np.full(registers.key.shape[1], self._max_frames, np.int32)
        places[new - first] = free
        self.registers = _place(self.registers, registers, jnp.asarray(places))
        self._admitted = stop

    def reserve(self, frames: int) -> None:
        """Makes room until `frames` frames fit; call after the first `append`."""
        if self._max_frames is None and self.registers is not None and frames > self._register_capacity:
            self._grow_registers(doubled(self._first_capacity, frames) - self._register_capacity)
        if self.position(frames) <= self.capacity:
            return
        if self._reach is not None and self.capacity:
            forgotten = self.count - self._reach
            buffers = (self.camera, self.refined)
            self.camera, self.refined = _slide(buffers, jnp.int32(forgotten - self._forgotten))
            self._forgotten = forgotten
            return
        self._grow(doubled(self._first_capacity, frames) - self.capacity)

    @property
    def _register_capacity(self) -> int:
        return 0 if self.registers is None else self.registers.key.shape[1]

    def _grow(self, room: int) -> None:
        self.camera, self.refined = _grown((self.camera, self.refined), room=room)

    def _grow_registers(self, room: int) -> None:
        self.registers = _grown(self.registers, room=room)

    def resize(self, unit: int) -> None:
        """Brings a store that keeps all camera tokens to the smallest multiple of `unit` frames that holds them."""
        room = -(-self.count // unit) * unit
        if room > self.capacity:
            self._grow(room - self.capacity)
            if self._max_frames is None and self.registers is not None:
                self._grow_registers(room - self._register_capacity)
            return
        self.camera, self.refined = jax.tree.map(lambda x: x[:, :room], (self.camera, self.refined))
        if self._max_frames is None:
            self.registers = jax.tree.map(lambda x: x[:, :room], self.registers)

    def copy(self) -> TokenStore:
        """A store of its own with the same frames."""
        other = copy.copy(self)
        buffers = (self.camera, self.refined, self.registers)
        # Not shared: programs give buffers back as they write to them.
        other.camera, other.refined, other.registers = jax.tree.map(jnp.copy, buffers)
        other._slots = self._slots.copy()
        return other

    def arrays(self) -> dict[str, np.ndarray]:
        """The stored frames and the sizes, on the host, for `restore`."""
        assert self.camera is not None and self.refined is not None
        stop = self.position(self.count)
        arrays = {
            "camera": np.asarray(self.camera[:, :stop]),
            "refined": np.asarray(self.refined[:, :stop]),
            "sizes": np.array([self.count, self.capacity, self._register_capacity]),
        }
        if self.registers is not None:
            self._admit(self.count)
            kept = self.count if self._max_frames is None else self._max_frames
            arrays |= {name: np.asarray(array[:, :kept]) for name, array in self.registers._asdict().items()}
            arrays["slots"] = self._slots
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes up what `arrays` gave, in buffers of the same capacity, so that no program compiles for another."""
        self.count, capacity, register_capacity = (int(size) for size in arrays["sizes"])
        self.camera, self.refined = (jnp.asarray(arrays[name]) for name in ("camera", "refined"))
        if "slots" in arrays:
            self.registers = RegisterKeys(*(jnp.asarray(arrays[name]) for name in RegisterKeys._fields))
            self._slots, self._admitted = arrays["slots"].copy(), self.count
        self._forgotten = self.count - self.camera.shape[1]
        self._grow(capacity - self.capacity)
        if self.registers is not None:
            self._grow_registers(register_capacity - self._register_capacity)
