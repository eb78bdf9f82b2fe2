"""A stream that takes one frame a call through caches: what the frame-by-frame methods share."""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.frame_by_frame import FrameByFrame
from logvggt_jax.model.key_value_cache import Caches, CameraMemory, KeyValueCache, empty
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.model.memory import Memory, RoundMemory
from logvggt_jax.model.padding import doubled
from logvggt_jax.model.parameters import in_compute_type
from logvggt_jax.model.windows import Windows
from logvggt_jax.streaming.program import Program, abstract_variables, flops_of
from logvggt_jax.streaming.results import (
    Cameras,
    FrameResult,
    Progress,
    Signals,
    checked_frames,
    decoded_cameras,
    device_memory,
    refuse_masks,
)
from logvggt_jax.streaming.rows import Rows
from logvggt_jax.types import WindowOutput

Memories = TypeVar("Memories")

# Entries of caches that hold one a frame, at first: a few kilobytes a frame.
CAMERA_CAPACITY = 256

_FAILED = "this stream has failed: open another one"


class StreamMemory(NamedTuple):
    """All that a stream carries from frame to frame.

    Attributes:
      blocks: of the aggregator's global blocks.
      camera: of GCCR and camera head.
    """

    blocks: Memory
    camera: CameraMemory


class Keeping(Protocol):
    """What a method keeps of a sequence: its caches, and their room."""

    def start(self, config: ModelConfig, tokens: int, frames: int = 1) -> StreamMemory:
        """Empty caches for frames of so many tokens, with room for at least so many frames where they keep all.

        Raises PredictionError where they cannot hold one.
        """
        ...

    def make_room(self, memory: StreamMemory, tokens: int, received: int) -> StreamMemory:
        """The caches with room for one more frame after `received`; may delete the buffers it was given."""
        ...


class _Flight(NamedTuple):
    """A frame whose results are on their way from the device."""

    output: WindowOutput
    encodings: jax.Array


@functools.partial(jax.jit, static_argnums=0, donate_argnums=2)
def _step(
    model: LogVGGT, variables: Variables, memory: Memory, frames: jax.Array, is_first: jax.Array
) -> tuple[Memory, WindowOutput]:
    return FrameByFrame(model.config).step(variables, memory, frames, is_first)


# A program of its own: where the camera's caches grow, the large one stays.
@functools.partial(jax.jit, static_argnums=0, donate_argnums=2)
def _locate(
    model: LogVGGT, variables: Variables, memory: CameraMemory, camera_tokens: jax.Array, register_tokens: jax.Array
) -> tuple[CameraMemory, jax.Array]:
    memory, encodings = FrameByFrame(model.config).locate(variables, memory, camera_tokens, register_tokens)
    return memory, encodings[0, :, -1]


class FrameSession:
    """Takes frames one by one and hands out depth and pose of each; nothing depends on a later frame.

    Args:
      model: whose parts are used; its windows are not.
      variables: {"params": …}.
      keeping: what the stream keeps; belongs to it alone.
      ahead: frames that may be on the device when `push` returns. With 1 the device works while the caller does, and a
        frame's results come with the next frame; with 0 they come at once.
    """

    def __init__(self, model: LogVGGT, variables: Variables, keeping: Keeping, *, ahead: int) -> None:
        self._model, self._keeping, self._ahead = model, keeping, ahead
        # Once, not at every call: cast, and brought to the device where they are numpy arrays.
        self._variables = jax.device_put(in_compute_type(variables, model.config))
        self._memory: StreamMemory | None = None
        self._flights: deque[_Flight] = deque()
        self._newest: np.ndarray | None = None
        self._image_size = (1, 1)  # (H, W), known with the first frame
        self._received = 0
        self._encodings = Rows(np.zeros((0, 9), np.float32))
        self._closed = False

    @property
    def num_frames(self) -> int:
        """Frames handed out so far; their depth and pose are final."""
        return len(self._encodings)

    @property
    def state_bytes(self) -> int:
        """See `Predictor.state_bytes`: the filled part of all caches."""
        return sum(_bytes(cache) * _filled(cache) // cache.capacity for cache in _caches(self._memory))

    @property
    def allocated_bytes(self) -> int:
        """Bytes of the device's memory that `state_bytes` lie in, empty places and all."""
        return sum(_bytes(cache) for cache in _caches(self._memory))

    def push(
        self, frames: np.ndarray | jax.Array | Sequence[np.ndarray], masks: np.ndarray | None = None
    ) -> list[FrameResult]:
        """Takes frames and returns those that became final; see `Predictor.push`. It takes no masks: caches do not know
        which of their keys count."""
        refuse_masks(masks, "windows, chunks or offline")
        if self._closed:
            raise ValueError("this stream is closed: open another one for another sequence")
        frames = checked_frames(frames, patch_size=self._model.config.encoder.patch_size, before=self._newest)
        self._image_size = (frames.shape[1], frames.shape[2])
        results: list[FrameResult] = []
        for frame in frames:
            with self._device_memory():
                self._one_frame(frame)
                self._newest = frame
                results += self._landed(self._ahead)
        return results

    def close(self, progress: Progress | None = None) -> list[FrameResult]:
        """Ends the stream: the frames still on their way, oldest first."""
        self._closed = True
        with self._device_memory():
            results = self._landed(0)
        self._memory = self._newest = None
        return results

    def snapshot(self) -> tuple[list[FrameResult], dict[str, np.ndarray]]:
        """See `Predictor.snapshot`: the caches whole, with their empty places. ValueError where the stream failed."""
        with self._device_memory():
            results = self._landed(0)
        if self._newest is None:
            return results, {}
        if self._memory is None:
            raise ValueError(_FAILED)
        leaves = jax.tree.leaves(self._memory)
        arrays = {f"memory/{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
        return results, {**arrays, "newest": self._newest, "encodings": self._encodings.array}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """See `Predictor.restore`."""
        if not arrays:
            return
        self._newest, self._encodings = arrays["newest"], Rows(arrays["encodings"])
        self._image_size = (self._newest.shape[0], self._newest.shape[1])
        self._received = len(self._encodings)
        tokens = tokens_a_frame(self._model.config, self._image_size)
        empty_ones = jax.eval_shape(lambda: self._keeping.start(self._model.config, tokens))
        kinds, structure = jax.tree.flatten(empty_ones)
        # Files hold scalars as arrays of one entry; caches may have grown since they were empty.
        leaves = [arrays[f"memory/{i}"] for i in range(len(kinds))]
        leaves = [leaf.reshape(()) if kind.ndim == 0 else leaf for leaf, kind in zip(leaves, kinds, strict=True)]
        self._memory = jax.tree.unflatten(structure, [jnp.asarray(leaf) for leaf in leaves])

    def cameras(self, *, provisional: bool = False) -> Cameras:
        """Cameras of the frames handed out so far; all are final."""
        return decoded_cameras(self._encodings.array, self._image_size, final=len(self._encodings))

    def signals(self) -> Signals:
        """See `Predictor.signals`: none."""
        return Signals.unknown(len(self._encodings))

    def _device_memory(self) -> AbstractContextManager[None]:
        height, width = self._image_size
        what = f"what the stream keeps of {self._received} frames of {height} x {width} pixels"
        return device_memory(what, "take smaller or fewer frames, or a method that keeps less")

    def _one_frame(self, frame: np.ndarray) -> None:
        """Starts the work on a frame; nothing here waits for the device but what makes room."""
        tokens = tokens_a_frame(self._model.config, self._image_size)
        memory = self._memory
        if memory is None and self._received:
            raise ValueError(_FAILED)
        if memory is None:
            memory = self._keeping.start(self._model.config, tokens)
        # The session holds no buffer that is about to be given back.
        self._memory = None
        blocks, camera = self._keeping.make_room(memory, tokens, self._received)
        is_first = jnp.asarray([self._received == 0])
        blocks, output = _step(self._model, self._variables, blocks, jnp.asarray(frame[None, None]), is_first)
        camera, encodings = _locate(self._model, self._variables, camera, output.camera_tokens, output.register_tokens)
        self._memory = StreamMemory(blocks, camera)
        self._received += 1
        # What is fetched is what is handed out.
        output = output.replace(camera_tokens=None, register_tokens=None, frame_mask=None)
        flight = _Flight(output, encodings)
        for array in jax.tree.leaves(flight):
            array.copy_to_host_async()
        self._flights.append(flight)

    def _landed(self, ahead: int) -> list[FrameResult]:
        """The results of all frames but the newest `ahead`."""
        results: list[FrameResult] = []
        while len(self._flights) > ahead:
            output, encodings = self._flights.popleft()
            self._encodings.append(np.asarray(encodings))
            depth, confidence, points, points_confidence = (
                None if x is None else np.asarray(x)[0, 0]
                for x in (output.depth, output.depth_confidence, output.points, output.points_confidence)
            )
            assert depth is not None and confidence is not None  # every model has a depth head
            results.append(
                FrameResult(
                    index=len(self._encodings) - 1,
                    depth=depth,
                    confidence=confidence,
                    pose_encoding=self._encodings.array[-1],
                    pose_is_final=True,
                    points=points,
                    points_confidence=points_confidence,
                )
            )
        return results


def tokens_a_frame(config: ModelConfig, image_size: tuple[int, int]) -> int:
    """P: camera and register tokens, and the patches of images of (H, W) pixels."""
    return config.aggregator.num_special + math.prod(Windows(config).grid(image_size))


def block_shape(config: ModelConfig, capacity: int) -> tuple[int, ...]:
    """Of the keys of a global block's cache, [1, capacity, heads, head_dim]."""
    heads = config.aggregator.num_heads
    return 1, capacity, heads, config.encoder.embed_dim // heads


def camera_memory(
    config: ModelConfig, kind: type[KeyValueCache], capacity: int, *, per_round: bool = True
) -> CameraMemory:
    """Empty caches of GCCR and camera head for `capacity` frames.

    With `per_round` every round of the head has its own caches; else one takes the entries of all R rounds.
    """
    head, width = config.camera_head, 2 * config.encoder.embed_dim
    rounds = head.iterations if per_round else None
    entries = capacity if per_round else capacity * head.iterations
    shape = (1, entries, head.num_heads, width // head.num_heads)
    trunk = Caches(tuple(empty(kind, shape, rounds=rounds) for _ in range(head.depth)))
    registers = None
    if config.refinement.enabled:
        registers = empty(kind, (1, capacity, config.aggregator.num_registers, width), config.dtype)
    return CameraMemory(RoundMemory(each=trunk) if per_round else RoundMemory(shared=trunk), registers)


def with_room(memory: Memories, entries: int, *, at_most: int | None = None) -> Memories:
    """The memory, whose caches have room for so many entries; where one had not, its capacity doubles.

    Buffers that were too small are given back one after the other, so that no more than one cache lies there twice.

    Args:
      memory: a pytree of caches.
      entries: as the caches count them.
      at_most: a capacity, enough for `entries`, that doubling does not exceed.
    """
    nodes, structure = jax.tree.flatten(memory, is_leaf=_is_cache)
    for i, cache in enumerate(nodes):
        if not _is_cache(cache) or cache.capacity >= entries:
            continue
        capacity = doubled(cache.capacity, entries)
        if at_most is not None:
            capacity = min(capacity, at_most)
        nodes[i] = _grown(cache, room=capacity - cache.capacity)
        cache.key.delete()
        cache.value.delete()
    grown: Memories = jax.tree.unflatten(structure, nodes)
    return grown


def camera_with_room(camera: CameraMemory, received: int, rounds: int) -> CameraMemory:
    """Caches that keep every frame, with room for one more after `received`."""
    trunk = RoundMemory(
        each=with_room(camera.trunk.each, received + 1),
        shared=with_room(camera.trunk.shared, (received + 1) * rounds),
    )
    return CameraMemory(trunk, with_room(camera.registers, received + 1))


def frame_program(model: LogVGGT, image_size: tuple[int, int], keeping: Keeping, num_frames: int | None) -> Program:
    """A frame's step with caches that have room for so many frames, or as they are at first."""
    variables, tokens = abstract_variables(model.config), tokens_a_frame(model.config, image_size)
    blocks = jax.eval_shape(lambda: keeping.start(model.config, tokens, num_frames or 1).blocks)
    frames = jax.ShapeDtypeStruct((1, 1, *image_size, 3), np.uint8)
    arguments = (variables, blocks, frames, jax.ShapeDtypeStruct((1,), bool))
    flops = flops_of(model, lambda chosen: FrameByFrame(chosen.config).step, *arguments)
    return Program(_step.lower(model, *arguments), flops, 1)


@functools.partial(jax.jit, static_argnames="room")
def _grown(cache: KeyValueCache, *, room: int) -> KeyValueCache:
    return cache.grown(room)


def _is_cache(node: Any) -> bool:
    return isinstance(node, KeyValueCache)


def _caches(memory: StreamMemory | None) -> list[KeyValueCache]:
    return [node for node in jax.tree.leaves(memory, is_leaf=_is_cache) if _is_cache(node)]


def _bytes(cache: KeyValueCache) -> int:
    # Without counts and other scalars.
    return sum(leaf.nbytes for leaf in jax.tree.leaves(cache) if leaf.ndim > 1)


def _filled(cache: KeyValueCache) -> int:
    """Entries that count; those of all rounds are alike."""
    return min(int(np.max(cache.length)), cache.capacity)
