"""Training batches from data sets, through Grain: shuffled, repeated, sharded by process, resumable.

Example i of a run is a function of the seed, i and the data. Workers read single clips; this process puts them
together to batches, so that neither the batches nor what a worker holds in memory depend on the other.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import cv2
import grain
import numpy as np
from absl import flags, logging

from logvggt_jax.config import check_size
from logvggt_jax.data.dataset import Dataset, DrawnOnDevice
from logvggt_jax.data.feeding.augmentation import ColourAugmentation
from logvggt_jax.data.feeding.broken_clips import BrokenClips
from logvggt_jax.data.feeding.clips import BROKEN, NAME, Size
from logvggt_jax.data.feeding.listed_frames import check_listed_frames
from logvggt_jax.data.feeding.mixture import FRAMES, SHAPES, TEACHERS, mixture
from logvggt_jax.data.feeding.sampling import CovisibleDataset, sampler_for
from logvggt_jax.data.worker_processes import end_with_parent
from logvggt_jax.errors import InputError, one_line

Batch = dict[str, np.ndarray]
# Workers that are killed are started again so many times, unless batches enough came in between.
_MOST_RESTARTS = 3
_RECOVERED = 100


class BatchIterator(Iterator[Batch]):
    """Endless batches whose state is the number of examples consumed and what was broken among them.

    Made by `training_batches`. Close it, or use it in a `with` block, to end its worker processes.

    Attributes:
      broken: clips of this process that were replaced.
      sizes: (H, W) of the batches; one that no sequence is near to does not occur.
      draw: for data drawn on the device, the JAX function that makes a batch of clips from what `next` returns.
      names: of the last batch's clips: data set, sequence and frames.
    """

    def __init__(
        self,
        examples: grain.MapDataset,
        identity: Mapping[str, Any],
        broken: BrokenClips,
        sizes: Sequence[Size],
        *,
        batch_size: int,
        process_index: int,
        process_count: int,
        worker_count: int,
        num_threads: int,
        draw: Callable[[Any], Any] | None = None,
    ) -> None:
        self.broken, self.sizes, self.draw = broken, tuple(sizes), draw
        self._examples, self._identity = examples, dict(identity)
        self._batch_size, self._worker_count, self._num_threads = batch_size, worker_count, num_threads
        self._process_index, self._process_count = process_index, process_count
        self._consumed = 0
        self._restarts = self._since_restart = 0
        self.names: list[str] = []
        self._clips: Iterator[dict[str, Any]] | None = None

    def __next__(self) -> Batch:
        """The next batch: this process's share of `batch_size` examples."""
        clips = self._read()
        self._consumed += self._batch_size
        messages = [message for clip in clips for message in clip.get(BROKEN, ())]
        self.broken.add(messages, clips=len(clips))
        self.names = [clip[NAME] for clip in clips]
        fields = clips[0].keys() - {BROKEN, NAME}
        return {name: np.stack([np.asarray(clip[name]) for clip in clips]) for name in sorted(fields)}

    def _read(self) -> list[dict[str, Any]]:
        """This process's clips of the next batch; workers that are killed are started again a few times."""
        while True:
            if self._clips is None:
                self._clips = self._open()
            try:
                clips = [next(self._clips) for _ in range(self._batch_size // self._process_count)]
            except BaseException as error:
                # What was read of this batch is lost with the stream; the next call starts at its first clip.
                self.close()
                if not _is_killed_worker(error):
                    raise
                self._restart(error)
                continue
            self._since_restart += 1
            if self._since_restart >= _RECOVERED:
                self._restarts = 0
            return clips

    def _restart(self, error: BaseException) -> None:
        self._restarts, self._since_restart = self._restarts + 1, 0
        mend = (
            "the system kills what takes too much memory, which fewer data.worker_count need less of; a container "
            "needs /dev/shm for three clips a worker"
        )
        if self._restarts > _MOST_RESTARTS:
            raise InputError(
                f"reading workers were killed {self._restarts} times with less than {_RECOVERED} batches in between "
                f"({one_line(error)}): {mend}"
            ) from error
        logging.warning(
            "a reading worker was killed (%s), all are started again (%d of %d times): %s",
            one_line(error),
            self._restarts,
            _MOST_RESTARTS,
            mend,
        )

    def __enter__(self) -> BatchIterator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends threads and worker processes; the next `next` starts them again where this left off."""
        if self._clips is not None:
            self._clips.close()  # type: ignore[attr-defined]
            self._clips = None

    def get_state(self) -> dict[str, Any]:
        """JSON values that `set_state` takes: examples consumed by all processes, and what they were drawn from.

        The number of workers and of processes is not part of it and may change on resume; so may the batch size as
        long as all clips have one size.
        """
        return {"examples": self._consumed, "broken": self.broken.get_state(), **self._identity}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continues after the examples that `state` counts; process 0 with its broken clips, the others with none.

        Raises InputError if the state is of another seed, clip or mixture, of sequences with other frames or of labels
        of another teacher, whose examples would differ.
        """
        expected = {"examples", "broken", *self._identity}
        # States of before these were listed pass without them.
        if set(state) | ({FRAMES, TEACHERS, SHAPES} & expected) != expected:
            raise InputError(
                f"data state has fields {sorted(state)}, expected {sorted(expected)}: "
                "it was written by another version or is damaged"
            )
        self.check_sources(state)
        for name, value in self._identity.items():
            if name not in (FRAMES, TEACHERS, SHAPES) and state[name] != value:
                raise InputError(
                    f"data state was written with {name}={state[name]}, this run has {value}: "
                    "resume with the same data settings, or start a new run"
                )
        self.close()
        self._consumed = int(state["examples"])
        # Those of all processes together, from which one counts on.
        self.broken.set_state(state["broken"] if self._process_index == 0 else BrokenClips(0.0).get_state())

    def check_sources(self, state: Mapping[str, Any]) -> None:
        """Raises InputError naming sequences that have other frames, or data sets that have labels of another teacher,
        than where `state`, of any clips, was written."""
        check_listed_frames(state.get(FRAMES, {}), self._identity[FRAMES])
        _check_teachers(state.get(TEACHERS, {}), self._identity.get(TEACHERS, {}))

    def _open(self) -> Iterator[dict[str, Any]]:
        start = self._consumed + self._process_index
        share = self._examples.slice(slice(start, None, self._process_count))
        # Grain's default of 500 elements is memory: a clip of 64 frames takes 90 MB.
        ahead = max(self._num_threads, 1)
        if not self._worker_count:
            ahead += self._batch_size // self._process_count
        stream = share.to_iter_dataset(grain.ReadOptions(num_threads=self._num_threads, prefetch_buffer_size=ahead))
        if self._worker_count:
            # Grain reads absl flags when it starts workers, which fails in scripts that do not use absl's app.
            if not flags.FLAGS.is_parsed():
                flags.FLAGS.mark_as_parsed()
            options = grain.MultiprocessingOptions(num_workers=self._worker_count, per_worker_buffer_size=1)
            stream = stream.mp_prefetch(options, worker_init_fn=_start_worker)
        return iter(stream)


def training_batches(
    datasets: Mapping[str, Dataset],
    *,
    clip_length: int,
    batch_size: int,
    sizes: Sequence[Size],
    seed: int,
    stride: tuple[int, int] = (1, 1),
    strides: Mapping[str, tuple[int, int]] | None = None,
    reverse: float = 0.5,
    weights: Mapping[str, float] | None = None,
    augmentation: ColourAugmentation | None = None,
    min_valid_depth: float = 0.0,
    max_broken: float = 0.0,
    process_index: int = 0,
    process_count: int = 1,
    worker_count: int = 0,
    num_threads: int = 2,
    state: Mapping[str, Any] | None = None,
) -> BatchIterator:
    """Endless batches of clips from a mixture of data sets.

    Each epoch of a data set visits each of its sequences once, in an order reshuffled every epoch, and takes one
    random clip. Example i of the mixture is a function of (`seed`, i) and the data alone; a batch holds
    `batch_size` consecutive examples, and process p of n gets those with i mod n = p. Sequences too short for a
    clip are left out with a warning.

    With several `sizes` a sequence has the one of the nearest aspect ratio. A batch holds clips of one size; sizes
    come as often as their sequences do under `weights`.

    A clip is broken if it cannot be read, fails `check_frames` or has too little depth. The one of the next index of
    its data set takes its place; where that set has none of this size that can be read, one of another shape, cut to
    the size, or of another set. Which one depends again on seed, index and data alone. It is logged and counted.

    Workers hand clips over in shared memory: in a container, /dev/shm must hold three clips a worker.

    Args:
      datasets: by name; frames are brought to their size by `transforms.fit`.
      clip_length: frames of a clip, T.
      batch_size: clips of a batch over all processes; a multiple of `process_count`.
      sizes: (H, W) each, multiples of 14.
      seed: not negative.
      stride: smallest and largest distance between a clip's frames.
      strides: the same for single data sets, by name. Sets without an order in time have none (`CovisibilityWalk`).
      reverse: probability of a clip that runs backwards in time.
      weights: share of examples from each data set, default equal.
      augmentation: of the images; None leaves them.
      min_valid_depth: smallest share of a clip's pixels that have depth.
      max_broken: largest share of broken clips, of a thousand clips at least. 0 raises the first one's error.
      process_index: of this process, below `process_count`.
      process_count: processes that train together.
      worker_count: reading processes; 0 reads in threads of this process.
      num_threads: reading threads of each process; 0 reads when a clip is asked for.
      state: of `BatchIterator.get_state`, to continue after the examples that it counts. Sequences keep the size that
        they had, even if their pictures can be read only now, or no more.

    Returns:
      Iterator of {"images" uint8 [B, T, H, W, 3], "depth" float32 [B, T, H, W] z-depth (0 = invalid),
      "intrinsics" float32 [B, T, 3, 3], "extrinsics" float32 [B, T, 4, 4] world-to-camera}, numpy, with
      B = batch_size / process_count. Of a data set drawn on the device (`DrawnOnDevice`), which must be the only
      one, it gives descriptions, and has the function `draw` that makes such a batch of them.

    Raises:
      InputError: an argument is out of range, a data set has no sequence long enough, or `state` is of other clips (see
        `BatchIterator.set_state`). While iterating:
        `TooManyBrokenClips`, or with max_broken=0 the error of bad data, named.
    """
    if not datasets:
        raise ValueError("no data sets given: pass a mapping from name to data set")
    if batch_size < 1 or process_count < 1 or batch_size % process_count:
        raise InputError(
            f"batch_size must be a positive multiple of process_count, got {batch_size} and {process_count}"
        )
    if not 0 <= process_index < process_count:
        raise ValueError(f"process_index must lie in [0, {process_count}), got {process_index}")
    if seed < 0 or worker_count < 0 or num_threads < 0:
        raise InputError(
            f"seed, worker_count and num_threads must not be negative, got {seed}, {worker_count} and {num_threads}"
        )
    if weights is not None and (set(weights) != set(datasets) or min(weights.values()) <= 0):
        raise InputError(f"weights must give a positive number for each of {', '.join(datasets)}, got {dict(weights)}")
    for name, share in {"min_valid_depth": min_valid_depth, "max_broken": max_broken}.items():
        if not 0 <= share < 1:
            raise InputError(f"{name} must lie in [0, 1), got {share}")
    sizes = [(int(height), int(width)) for height, width in sizes]
    if not sizes or len(set(sizes)) < len(sizes):
        raise InputError(f"sizes must be different (height, width), at least one, got {sizes}")
    for size in sizes:
        check_size(size, "sizes")
    draw = _drawing(datasets, sizes, augmentation)
    strides = dict(strides or {})
    if not strides.keys() <= datasets.keys():
        raise InputError(f"strides must be of {', '.join(datasets)}, got those of {', '.join(strides)}")
    for name in strides:
        if isinstance(datasets[name], CovisibleDataset):
            raise InputError(f"{name}: its frames have no order in time, and its clips no stride: leave stride out")
    samplers = {
        name: sampler_for(dataset, length=clip_length, stride=strides.get(name, stride), reverse=reverse)
        for name, dataset in datasets.items()
    }
    shares = {name: 1.0 if weights is None else float(weights[name]) for name in datasets}
    examples, identity, occurring = mixture(
        datasets,
        samplers,
        shares,
        sizes,
        batch_size=batch_size,
        seed=seed,
        augmentation=augmentation,
        min_valid_depth=min_valid_depth,
        replace_broken=max_broken > 0,
        shapes=(state or {}).get(SHAPES, {}),
    )
    batches = BatchIterator(
        examples,
        identity,
        BrokenClips(max_broken),
        occurring,
        batch_size=batch_size,
        process_index=process_index,
        process_count=process_count,
        worker_count=worker_count,
        num_threads=num_threads,
        draw=draw,
    )
    if state is not None:
        batches.set_state(state)
    return batches


def _drawing(
    datasets: Mapping[str, Dataset], sizes: Sequence[Size], augmentation: ColourAugmentation | None
) -> Callable[[Any], Any] | None:
    """What draws the clips on the device; None where they are read as pictures.

    Raises InputError for what can only be done to pictures on the host.
    """
    for name, dataset in datasets.items():
        if not isinstance(dataset, DrawnOnDevice):
            continue
        where = f"{name} is drawn on the device (renderer='device')"
        if len(datasets) > 1:
            raise InputError(f"{where} and cannot be mixed with {', '.join(datasets.keys() - {name})}: use 'host'")
        if augmentation is not None:
            raise InputError(
                f"{where}, where data.augmentation does not reach its pictures: use 'host' or set it to None"
            )
        drawn = dataset.image_size(dataset.sequences[0])
        if any(size != drawn for size in sizes):
            raise InputError(
                f"{where} at {drawn[0]} x {drawn[1]}, and the stage asks for sizes {[tuple(size) for size in sizes]}: "
                "give height and width of the set the size of the stage, or use 'host'"
            )
        return dataset.draw
    return None


def _check_teachers(then: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Raises InputError naming the data sets, of those in both, that another teacher labels now."""
    changed = [f"{name} {then[name]}, now {now[name]}" for name in then if name in now and then[name] != now[name]]
    if changed:
        raise InputError(
            f"the checkpoint was written with labels of another teacher (digests: {'; '.join(changed)}): set "
            "teacher.weights to the same weights, which may lie in another folder, or start a new --workdir, which "
            "--config.initial_weights lets begin with the model of this one"
        )


def _is_killed_worker(error: BaseException) -> bool:
    # Grain has no error of its own for this.
    return isinstance(error, RuntimeError) and "Worker process was terminated unexpectedly" in str(error)


def _start_worker(index: int, count: int) -> None:
    end_with_parent()
    # Workers are there to use the cores; OpenCV would start as many threads again in each of them.
    cv2.setNumThreads(1)
    # A signal to the whole group is for the process that trains: it needs clips until it has decided to stop, and
    # ends its workers itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
