"""Training batches from data sets, through Grain: shuffled, repeated, sharded by process, resumable."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import grain
import numpy as np
from absl import flags, logging

from logvggt_jax.data.dataset import Dataset, check_frames
from logvggt_jax.data.sampling import Sampler, example_rng, sampler_for
from logvggt_jax.data.transforms import fit

Batch = dict[str, np.ndarray]


class _ReadClip:
    """Turns (example index, sequence name) into one clip; a class, so that worker processes can unpickle it."""

    def __init__(self, name: str, dataset: Dataset, sampler: Sampler, size: tuple[int, int], seed: int) -> None:
        self.name, self.dataset, self.sampler, self.size, self.seed = name, dataset, sampler, size, seed

    def __call__(self, index: int, sequence: str) -> Batch:
        rng = example_rng(self.seed, index)
        indices = self.sampler.draw(self.dataset, sequence, rng)
        frames = self.dataset.read(sequence, [int(i) for i in indices])
        check_frames(frames, f"{self.name}, {sequence}, frames {indices[0]} … {indices[-1]}")
        fitted = fit(frames, self.size)
        return {
            "images": fitted.images,
            "depth": fitted.depth,
            "intrinsics": fitted.intrinsics,
            "extrinsics": fitted.extrinsics,
        }


class BatchIterator(Iterator[Batch]):
    """Endless batches whose whole state is the number of examples consumed.

    Made by `training_batches`. Close it, or use it in a `with` block, to end its worker processes.
    """

    def __init__(
        self,
        examples: grain.MapDataset,
        identity: Mapping[str, Any],
        *,
        batch_size: int,
        process_index: int,
        process_count: int,
        worker_count: int,
        num_threads: int,
    ) -> None:
        self._examples, self._identity = examples, dict(identity)
        self._batch_size, self._worker_count, self._num_threads = batch_size, worker_count, num_threads
        self._process_index, self._process_count = process_index, process_count
        self._consumed = 0
        self._batches: Iterator[Batch] | None = None

    def __next__(self) -> Batch:
        """The next batch: this process's share of `batch_size` examples."""
        if self._batches is None:
            self._batches = self._open()
        batch = next(self._batches)
        self._consumed += self._batch_size
        return batch

    def __enter__(self) -> BatchIterator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends threads and worker processes; the next `next` starts them again where this left off."""
        if self._batches is not None:
            self._batches.close()  # type: ignore[attr-defined]
            self._batches = None

    def get_state(self) -> dict[str, Any]:
        """JSON values that `set_state` takes: examples consumed by all processes, and what they were drawn from.

        The number of workers, of processes and the batch size are not part of it and may change on resume.
        """
        return {"examples": self._consumed, **self._identity}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continues after the examples that `state` counts.

        Raises ValueError if the state is of another seed, clip or mixture, whose examples would differ.
        """
        expected = {"examples", *self._identity}
        if set(state) != expected:
            raise ValueError(
                f"data state has fields {sorted(state)}, expected {sorted(expected)}: "
                "it was written by another version or is damaged"
            )
        for name, value in self._identity.items():
            if state[name] != value:
                raise ValueError(
                    f"data state was written with {name}={state[name]}, this run has {value}: "
                    "resume with the same data settings, or start a new run"
                )
        self.close()
        self._consumed = int(state["examples"])

    def _open(self) -> Iterator[Batch]:
        start = self._consumed + self._process_index
        share = self._examples.slice(slice(start, None, self._process_count))
        batches = share.batch(self._batch_size // self._process_count, drop_remainder=True)
        # Elements are whole batches by now: two for each thread are plenty, Grain's default of 500 is memory.
        options = grain.ReadOptions(num_threads=self._num_threads, prefetch_buffer_size=2 * max(self._num_threads, 1))
        stream = batches.to_iter_dataset(options)
        if self._worker_count:
            # Grain reads absl flags when it starts workers, which fails in scripts that do not use absl's app.
            if not flags.FLAGS.is_parsed():
                flags.FLAGS.mark_as_parsed()
            stream = stream.mp_prefetch(
                grain.MultiprocessingOptions(num_workers=self._worker_count, per_worker_buffer_size=1)
            )
        return iter(stream)


def training_batches(
    datasets: Mapping[str, Dataset],
    *,
    clip_length: int,
    batch_size: int,
    size: tuple[int, int],
    seed: int,
    stride: tuple[int, int] = (1, 1),
    strides: Mapping[str, tuple[int, int]] | None = None,
    reverse: float = 0.5,
    weights: Mapping[str, float] | None = None,
    process_index: int = 0,
    process_count: int = 1,
    worker_count: int = 0,
    num_threads: int = 2,
) -> BatchIterator:
    """Endless batches of clips from a mixture of data sets.

    Each epoch of a data set visits each of its sequences once, in an order reshuffled every epoch, and takes one
    random clip. Example i of the mixture is a function of (`seed`, i) and the data alone; a batch holds
    `batch_size` consecutive examples, and process p of n gets those with i mod n = p. Sequences too short for a
    clip are left out with a warning.

    Args:
      datasets: by name; frames are checked by `check_frames` and brought to `size` by `transforms.fit`.
      clip_length: frames of a clip, T.
      batch_size: clips of a batch over all processes; a multiple of `process_count`.
      size: (H, W), multiples of 14.
      seed: not negative.
      stride: smallest and largest distance between a clip's frames.
      strides: the same for single data sets, by name. Sets without an order in time have none (`CovisibilityWalk`).
      reverse: probability of a clip that runs backwards in time.
      weights: share of examples from each data set, default equal.
      process_index: of this process, below `process_count`.
      process_count: processes that train together.
      worker_count: reading processes; 0 reads in threads of this process.
      num_threads: reading threads of each process; 0 reads when a batch is asked for.

    Returns:
      Iterator of {"images" uint8 [B, T, H, W, 3], "depth" float32 [B, T, H, W] z-depth (0 = invalid),
      "intrinsics" float32 [B, T, 3, 3], "extrinsics" float32 [B, T, 4, 4] world-to-camera}, numpy, with
      B = batch_size / process_count.

    Raises:
      ValueError: an argument is out of range, or a data set has no sequence long enough. While iterating: bad
        data, named.
    """
    if not datasets:
        raise ValueError("no data sets given: pass a mapping from name to data set")
    if batch_size < 1 or process_count < 1 or batch_size % process_count:
        raise ValueError(
            f"batch_size must be a positive multiple of process_count, got {batch_size} and {process_count}"
        )
    if not 0 <= process_index < process_count:
        raise ValueError(f"process_index must lie in [0, {process_count}), got {process_index}")
    if seed < 0 or worker_count < 0 or num_threads < 0:
        raise ValueError(
            f"seed, worker_count and num_threads must not be negative, got {seed}, {worker_count} and {num_threads}"
        )
    if weights is not None and (set(weights) != set(datasets) or min(weights.values()) <= 0):
        raise ValueError(f"weights must give a positive number for each of {', '.join(datasets)}, got {dict(weights)}")
    strides = dict(strides or {})
    if not strides.keys() <= datasets.keys():
        raise ValueError(f"strides must be of {', '.join(datasets)}, got those of {', '.join(strides)}")
    samplers = {
        name: sampler_for(dataset, length=clip_length, stride=strides.get(name, stride), reverse=reverse)
        for name, dataset in datasets.items()
    }

    sources, counts = [], {}
    for position, (name, dataset) in enumerate(datasets.items()):
        sampler = samplers[name]
        names = [sequence for sequence in dataset.sequences if sampler.fits(dataset, sequence)]
        if not names:
            raise ValueError(
                f"{name}: none of {len(dataset.sequences)} sequences has {sampler.requirement}: shorten the clips"
            )
        if len(names) < len(dataset.sequences):
            short = len(dataset.sequences) - len(names)
            logging.warning("%s: %d sequences do not have %s, left out", name, short, sampler.requirement)
        # Each data set draws from its own stream, so that equal sizes do not mean equal choices.
        own_seed = int(np.random.SeedSequence([seed, position]).generate_state(1)[0])
        read = _ReadClip(name, dataset, sampler, size, own_seed)
        sources.append(grain.MapDataset.source(names).seed(own_seed).shuffle().repeat().map_with_index(read))
        counts[name] = len(names)
    shares = [1.0 if weights is None else float(weights[name]) for name in datasets]
    examples = sources[0] if len(sources) == 1 else grain.MapDataset.mix(sources, weights=shares)
    identity = {
        "seed": seed,
        "samplers": {name: repr(sampler) for name, sampler in samplers.items()},
        "size": [size[0], size[1]],
        "sequences": counts,
        "weights": dict(zip(datasets, shares, strict=True)),
    }
    return BatchIterator(
        examples,
        identity,
        batch_size=batch_size,
        process_index=process_index,
        process_count=process_count,
        worker_count=worker_count,
        num_threads=num_threads,
    )
