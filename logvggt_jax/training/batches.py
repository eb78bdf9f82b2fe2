"""The data streams of a run: data sets opened once, one stream for each image size of a stage."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from absl import logging

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.holdouts import check_disjoint, check_held_out
from logvggt_jax.data.pipeline import BatchIterator, training_batches
from logvggt_jax.data.registry import open_dataset
from logvggt_jax.data.room_pool import render_pool
from logvggt_jax.data.rooms import Rooms
from logvggt_jax.training.config import DataConfig, SourceConfig, StageConfig


class BatchesInTurn:
    """Endless batches from several streams in turn; a context manager that ends their threads.

    The state counts what was handed out, so that it agrees with the training state when it is read before the
    next batch is drawn.
    """

    def __init__(self, streams: Sequence[BatchIterator]) -> None:
        self._streams = list(streams)
        self._turn = 0

    def __enter__(self) -> BatchesInTurn:
        return self

    def __exit__(self, *_: Any) -> None:
        for stream in self._streams:
            stream.close()

    def __next__(self) -> dict[str, np.ndarray]:
        batch = next(self._streams[self._turn])
        self._turn = (self._turn + 1) % len(self._streams)
        return batch

    def get_state(self) -> dict[str, Any]:
        """JSON values for `set_state`."""
        return {"turn": self._turn, "streams": [stream.get_state() for stream in self._streams]}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Goes on where `get_state` was called; ValueError if the streams are others."""
        if len(state["streams"]) != len(self._streams):
            raise ValueError(
                f"the data state is of {len(state['streams'])} image sizes, this stage has {len(self._streams)}: "
                "set stages back or start a new --workdir"
            )
        self._turn = int(state["turn"])
        for stream, saved in zip(self._streams, state["streams"], strict=True):
            stream.set_state(saved)


def open_source(source: SourceConfig) -> Dataset:
    """The data set of one source; options make a `Rooms` of that description."""
    if source.name != "rooms":
        if source.options:
            raise ValueError(f"data set {source.name!r} takes no options, got {dict(source.options)}; remove them")
        return open_dataset(source.name, source.root, source.split)
    try:
        return Rooms(source.split, **dict(source.options))
    except TypeError as error:
        raise ValueError(f"options of the data set 'rooms': {error}") from error


def open_sources(config: DataConfig, validation: SourceConfig | None = None) -> dict[str, Dataset]:
    """The mixture's data sets by name; rooms are rendered here, once, since rendering costs more than training.

    Raises:
      FileNotFoundError: folders of data sets do not exist and `config.allow_missing` is off, or none exists; named.
      ValueError: a data set would train on sequences that `config.hold_out` or the `validation` source keeps.
    """
    rules = dict(config.hold_out)
    datasets: dict[str, Dataset] = {}
    for source in _present(config):
        dataset = open_source(source)
        if source.name in rules:
            check_held_out(
                source.name, dataset.sequences, rules[source.name], functools.partial(_split_sequences, source)
            )
        if validation is not None and (validation.name, validation.root) == (source.name, source.root):
            check_disjoint(source.name, dataset.sequences, open_source(validation).sequences)
        if isinstance(dataset, Rooms):
            dataset = render_pool(dataset, cache_dir=config.cache_dir, progress=jax.process_index() == 0)
        datasets[source.name] = dataset
    return datasets


def _split_sequences(source: SourceConfig, split: str) -> Sequence[str]:
    return open_source(dataclasses.replace(source, split=split)).sequences


def _present(config: DataConfig) -> list[SourceConfig]:
    """The sources whose folders exist."""
    missing = [source for source in config.sources if source.root is not None and not Path(source.root).is_dir()]
    if not missing:
        return list(config.sources)
    named = ", ".join(f"{source.name} ({source.root})" for source in missing)
    if not config.allow_missing:
        raise FileNotFoundError(
            f"data sets without their folder: {named}; set data.sources.NAME.root, remove them from the mixture, or "
            "train on the others with data.allow_missing=True"
        )
    present = [source for source in config.sources if source not in missing]
    if not present:
        raise FileNotFoundError(f"none of the data sets has its folder: {named}; set data.sources.NAME.root")
    total = sum(source.weight for source in present)
    shares = ", ".join(f"{source.name} {source.weight / total:.1%}" for source in present)
    logging.warning("data sets without their folder are left out: %s; clips come from %s", named, shares)
    return present


def stage_batches(
    datasets: Mapping[str, Dataset], config: DataConfig, stage: StageConfig, *, seed: int
) -> BatchesInTurn:
    """This process's share of the batches of a stage; `seed` is the stage's own."""
    sources = [source for source in config.sources if source.name in datasets]
    streams = [
        training_batches(
            datasets,
            clip_length=stage.clip_length,
            batch_size=stage.batch_size,
            size=size,
            seed=seed * len(stage.sizes) + position,
            stride=(stage.min_stride, stage.max_stride),
            strides={source.name: source.stride for source in sources if source.stride is not None},
            reverse=config.reverse,
            weights={source.name: source.weight for source in sources},
            process_index=jax.process_index(),
            process_count=jax.process_count(),
            worker_count=config.worker_count,
            num_threads=config.num_threads,
        )
        for position, size in enumerate(stage.sizes)
    ]
    return BatchesInTurn(streams)
