"""Overlapping chunks chained by robust similarities, for a predictor that knows no memory.

Public VGGT weights never learned to pass the reference on from window to window. Long sequences are then cut into
chunks as long as memory allows, each predicted in the frame of its own first camera and in its own unit, and carried
into the first chunk's by the similarity that fits the frames which neighbours share (VGGT-Long). Loops are closed at
the end where that is asked for, see `loops.py`.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager

import jax
import numpy as np

from logvggt_jax.config import require_counts
from logvggt_jax.errors import InputError
from logvggt_jax.geometry import NoSimilarity
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.model.parameters import in_compute_type
from logvggt_jax.streaming.alignment import align, move, residual
from logvggt_jax.streaming.loops import LoopCloser, LoopSettings, frame_describer, loop_settings
from logvggt_jax.streaming.named_arrays import of_part, part_of
from logvggt_jax.streaming.offline import FinalFrames, PlainPrediction, lowered_plain, plain_program, predict_plain
from logvggt_jax.streaming.program import Program
from logvggt_jax.streaming.results import (
    Cameras,
    FrameResult,
    PredictionError,
    Progress,
    Signals,
    checked_frames,
    checked_masks,
    device_memory,
)

PredictChunk = Callable[..., PlainPrediction]


@dataclasses.dataclass(frozen=True)
class ChunkPlan:
    """Chunks of `size` frames, neighbours sharing `overlap` of them (VGGT-Long's numbers).

    `loops` closes loops when the sequence ends: True, or how they are looked for; chunks are then what moves as one.
    """

    size: int = 60
    overlap: int = 30
    loops: LoopSettings | bool = False

    def __post_init__(self) -> None:
        require_counts(self, "size", "overlap")
        if not self.overlap < self.size:
            raise InputError(
                f"chunk overlap must be at least 1 frame and below the chunk size {self.size}, got {self.overlap}: "
                "neighbours are aligned by the frames they share, and each has to add some"
            )

    def ranges(self, num_frames: int) -> list[tuple[int, int]]:
        """Frames [start, stop) of every chunk of a sequence; the last one may be shorter."""
        step = self.size - self.overlap
        starts = range(0, max(num_frames - self.overlap, 1), step)
        return [(start, min(start + self.size, num_frames)) for start in starts]


class ChunkChain:
    """Takes a sequence frame by frame and hands out predictions in the first chunk's frame and unit.

    Of a frame that several chunks hold, the last one's prediction counts. No more than one chunk of images and
    predictions is held.

    Args:
      predict: images [n, H, W, 3] of a chunk, and their masks bool [n, H, W] where they have some, to its prediction,
        in a frame and unit of the chunk's own.
      plan: sizes of the chunks.
    """

    def __init__(self, predict: PredictChunk, plan: ChunkPlan) -> None:
        self._predict, self._plan = predict, plan
        self._images: list[np.ndarray] = []
        self._masks: list[np.ndarray] = []  # of the images; empty where there are none
        self._shared: PlainPrediction | None = None
        self._first = 0
        # Of every chunk but the first: the first frame that it adds, its scale and its residual, see `Signals`.
        self.joints: list[tuple[int, float, float]] = []

    def push(self, image: np.ndarray, mask: np.ndarray | None = None) -> PlainPrediction | None:
        """Takes the next image [H, W, 3] and its mask; the frames that became final with it, oldest first, if any.

        Raises:
          PredictionError: a chunk cannot be aligned with the one before.
        """
        self._images.append(image)
        self._masks += [] if mask is None else [mask]
        if len(self._images) < self._plan.size:
            return None
        chunk = self._next_chunk()
        step = self._plan.size - self._plan.overlap
        # A copy: a view would keep the whole chunk alive.
        self._shared = jax.tree.map(lambda x: x[step:].copy(), chunk)
        self._images, self._masks = self._images[step:], self._masks[step:]
        self._first += step
        return jax.tree.map(lambda x: x[:step], chunk)

    def close(self) -> PlainPrediction | None:
        """Ends the sequence: the frames still held; None if there was no frame. Errors as in `push`."""
        if not self._images:
            return None
        known = 0 if self._shared is None else self._plan.overlap
        last = self._shared if len(self._images) == known else self._next_chunk()
        self._images, self._masks, self._shared = [], [], None
        return last

    @property
    def held_bytes(self) -> int:
        """Bytes of the images held and of what the next chunk is aligned with."""
        return sum(array.nbytes for array in (*self._images, *self._masks, *jax.tree.leaves(self._shared)))

    def arrays(self) -> dict[str, np.ndarray]:
        """The images held and the last chunk's prediction of those it shares, for `restore`."""
        arrays = {"images": np.stack(self._images), "first": np.array([self._first])} if self._images else {}
        if self._masks:
            arrays["masks"] = np.stack(self._masks)
        if self.joints:
            arrays["joints"] = np.array(self.joints, np.float64)
        shared = {} if self._shared is None else self._shared._asdict()
        return arrays | of_part("shared", {name: value for name, value in shared.items() if value is not None})

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes up what `arrays` gave."""
        if "images" in arrays:
            self._images, self._first = list(arrays["images"]), int(arrays["first"][0])
            self._masks = list(arrays.get("masks", ()))
        if "joints" in arrays:
            self.joints = [(int(first), scale, apart) for first, scale, apart in arrays["joints"].tolist()]
        if shared := part_of(arrays, "shared"):
            self._shared = PlainPrediction(**shared)

    def _next_chunk(self) -> PlainPrediction:
        chunk = self._predict(*(np.stack(arrays) for arrays in (self._images, self._masks) if arrays))
        if self._shared is None:
            return chunk
        shared = self._plan.overlap
        try:
            similarity = align(jax.tree.map(lambda x: x[:shared], chunk), self._shared)
        except NoSimilarity as error:
            raise PredictionError(
                f"the chunk from frame {self._first} to {self._first + len(self._images) - 1} cannot be aligned with "
                f"the one before on the {shared} frames they share ({error}); take larger chunks with more overlap"
            ) from error
        moved = move(chunk, similarity)
        apart = residual(jax.tree.map(lambda x: x[:shared], moved), self._shared)
        self.joints.append((self._first + shared, similarity.scale, apart))
        return moved


def chunk_program(model: LogVGGT, image_size: tuple[int, int], plan: ChunkPlan, num_frames: int | None) -> Program:
    """A full chunk, or the whole of a shorter sequence; all but the overlap become final with it."""
    size = min(plan.size, num_frames or plan.size)
    final = size - plan.overlap if size == plan.size else size
    return plain_program(model, image_size, size)._replace(frames=final)


def chunk_opening(
    model: LogVGGT, image_size: tuple[int, int], plan: ChunkPlan, num_frames: int | None
) -> list[jax.stages.Lowered]:
    """A full chunk's program where there is sure to be one, see `Method.opening`."""
    return [lowered_plain(model, image_size, plan.size)] if num_frames and num_frames > plan.size else []


class ChunkSession:
    """Takes frames like a `StreamSession` and hands them out chunk by chunk, depth and pose final.

    The world is the first chunk's first camera, the unit the first chunk's. Memory is that of one chunk, and the
    cameras; with loops also the places, see `LoopSettings`, and no pose is final before the end.

    Args:
      model: whose parts are used; its windows are not.
      variables: {"params": …}.
      plan: sizes of the chunks.
    """

    def __init__(self, model: LogVGGT, variables: Variables, plan: ChunkPlan) -> None:
        # Once, not for every chunk: cast, and brought to the device where they are numpy arrays.
        predict = functools.partial(predict_plain, model, jax.device_put(in_compute_type(variables, model.config)))
        self._patch_size, self._plan = model.config.encoder.patch_size, plan
        self._chain = ChunkChain(predict, plan)
        self._newest: np.ndarray | None = None
        self._newest_mask: np.ndarray | None = None
        self._final = FinalFrames()
        self._loops: LoopCloser | None = None
        if (settings := loop_settings(plan.loops)) is not None:
            settings = dataclasses.replace(
                settings, stretch=plan.size - plan.overlap, frames=min(settings.frames, max(1, plan.size // 2))
            )
            self._loops = LoopCloser(frame_describer(model, predict.args[1]), predict, settings)
        self._cameras: Cameras | None = None
        self._closed = False

    @property
    def num_frames(self) -> int:
        """Frames handed out so far; their depth is final."""
        return len(self._final)

    @property
    def state_bytes(self) -> int:
        """See `Predictor.state_bytes`: at most a chunk of images, and the prediction of an overlap."""
        return self._chain.held_bytes

    def push(
        self, frames: np.ndarray | jax.Array | Sequence[np.ndarray], masks: np.ndarray | None = None
    ) -> list[FrameResult]:
        """Takes frames and returns those that became final; see `Predictor.push`."""
        if self._closed:
            raise ValueError("this stream is closed: make another ChunkSession for another sequence")
        results: list[FrameResult] = []
        frames = checked_frames(frames, patch_size=self._patch_size, before=self._newest)
        masks = checked_masks(masks, frames, before=self._newest, mask_before=self._newest_mask)
        for frame, mask in zip(frames, [None] * len(frames) if masks is None else masks, strict=True):
            self._newest, self._newest_mask = frame, mask
            if self._loops is not None:
                self._loops.see(frame, mask)
            with self._memory():
                results += self._handed_out(self._chain.push(frame, mask))
        return results

    def close(self, progress: Progress | None = None) -> list[FrameResult]:
        """Ends the stream: the frames still held; PredictionError where the last chunk does not fit the others."""
        if self._closed:
            return []
        self._closed, self._newest, self._newest_mask = True, None, None
        with self._memory():
            results = self._handed_out(self._chain.close())
            if self._loops is not None and len(self._final):
                self._cameras = self._loops.close(self._final.cameras())
        return results

    def snapshot(self) -> tuple[list[FrameResult], dict[str, np.ndarray]]:
        """See `Predictor.snapshot`: the images of the chunk to come, and what the next is aligned with."""
        if self._closed:
            return [], {}
        loops = {} if self._loops is None else of_part("loops", self._loops.arrays())
        return [], {**of_part("final", self._final.arrays()), **self._chain.arrays(), **loops}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """See `Predictor.restore`."""
        self._final.restore(part_of(arrays, "final"))
        self._chain.restore(arrays)
        if self._loops is not None:
            self._loops.restore(part_of(arrays, "loops"))
        if "images" in arrays:
            self._newest = arrays["images"][-1]
            self._newest_mask = arrays["masks"][-1] if "masks" in arrays else None

    def cameras(self, *, provisional: bool = False) -> Cameras:
        """Cameras of the frames handed out so far; all are final, but with loops, which change them at the end."""
        if self._cameras is not None:
            return self._cameras
        cameras = self._final.cameras()
        return cameras if self._loops is None else cameras._replace(is_final=np.zeros(len(self._final), bool))

    def signals(self) -> Signals:
        """See `Predictor.signals`: how the chunks handed out fit one another."""
        signals = Signals.unknown(len(self._final))
        for first, scale, apart in self._chain.joints:
            if first < len(self._final):
                signals.chunk_scale[first], signals.chunk_residual[first] = scale, apart
        return signals

    def _handed_out(self, prediction: PlainPrediction | None) -> list[FrameResult]:
        results = self._final.add(prediction)
        if self._loops is None:
            return results
        self._loops.take(results)
        return [dataclasses.replace(result, pose_is_final=False) for result in results]

    def _memory(self) -> AbstractContextManager[None]:
        return device_memory(f"a chunk of {self._plan.size} frames", "take a smaller chunk size")
