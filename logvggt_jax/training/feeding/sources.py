"""The data sets of a run, opened once, with what must not be trained on left out of them."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import jax
from absl import logging

from logvggt_jax.data.dataset import Dataset, Reader
from logvggt_jax.data.errors import EmptySplit
from logvggt_jax.data.feeding.frame_range import FrameRange
from logvggt_jax.data.feeding.holdouts import check_disjoint, check_held_out
from logvggt_jax.data.packed.index import is_packed
from logvggt_jax.data.registry import DATASETS, READERS, checked_options, open_dataset
from logvggt_jax.errors import InputError
from logvggt_jax.training.config import DataConfig, SourceConfig


def open_source(source: SourceConfig) -> Dataset:
    """The data set of one source, made with its options, and of its frames those that it names."""
    return _frames_of(source, _reader(source))


def _reader(source: SourceConfig) -> Reader:
    return open_dataset(source.name, source.root, source.split, **dict(source.options))


def _frames_of(source: SourceConfig, dataset: Dataset) -> Dataset:
    return dataset if source.frames is None else FrameRange(dataset, source.frames, source.name)


def open_sources(config: DataConfig, validation: Sequence[SourceConfig] = ()) -> dict[str, Dataset]:
    """The mixture's data sets by name, in the form in which training reads them; what has to be made is made here.

    Raises InputError: folders of data sets do not exist and `config.allow_missing` is off, or none exists; a source of
    `validation` has no folder; a data set would train on sequences that `config.hold_out` or one of those keeps.
    """
    _check_folders(config, validation)
    rules = dict(config.hold_out)
    if unknown := sorted(rules.keys() - set(DATASETS)):
        raise InputError(
            f"data.hold_out names unknown data sets: {', '.join(unknown)}; known are {', '.join(DATASETS)}"
        )
    datasets: dict[str, Dataset] = {}
    for source in _present(config):
        reader = _reader(source)
        if source.name in rules:
            check_held_out(
                source.name, reader.sequences, rules[source.name], functools.partial(_split_sequences, source)
            )
        for kept in validation:
            if kept.name == source.name and not _hold_others(source, kept):
                check_disjoint(source.name, _frames_of(source, reader), open_source(kept))
        progress = jax.process_index() == 0
        made = reader.for_training(cache_dir=config.cache_dir, progress=progress)
        datasets[source.name] = _frames_of(source, made)
    return datasets


def _hold_others(one: SourceConfig, other: SourceConfig) -> bool:
    """Whether sequences of one name are not the same in two sources of one data set: recordings of one's own in folders
    that lie apart. Names in published sets do not depend on where a copy lies, and packed ones may be of either folder.
    """
    roots = [Path(source.root) for source in (one, other) if source.root is not None]
    if not READERS[one.name].own or len(roots) < 2 or any(map(is_packed, roots)):
        return False
    first, second = (root.resolve() for root in roots)
    return not (first.is_relative_to(second) or second.is_relative_to(first))


def _split_sequences(source: SourceConfig, split: str) -> Sequence[str]:
    try:
        return open_source(dataclasses.replace(source, split=split)).sequences
    except EmptySplit:  # A partial copy without the sequences that are evaluated on.
        return ()


def _present(config: DataConfig) -> list[SourceConfig]:
    """The sources whose folders exist."""
    missing = _without_folder(config.sources)
    if not missing:
        return list(config.sources)
    present = [source for source in config.sources if source not in missing]
    total = sum(source.weight for source in present)
    shares = ", ".join(f"{source.name} {source.weight / total:.1%}" for source in present)
    logging.warning("data sets without their folder are left out: %s; clips come from %s", _named(missing), shares)
    return present


def _check_folders(config: DataConfig, validation: Sequence[SourceConfig]) -> None:
    """Raises InputError naming all data sets, to train and to validate on, that have to have a folder and have none, or
    one that does not exist."""
    for source in (*config.sources, *validation):
        checked_options(source.name, dict(source.options))
    problems = []
    missing = _without_folder(config.sources)
    if missing and len(missing) == len(config.sources):
        problems.append(f"none of the data sets has its folder: {_named(missing)}; set data.sources.NAME.root")
    elif missing and not config.allow_missing:
        problems.append(
            f"data sets without their folder: {_named(missing)}; set data.sources.NAME.root, remove them from the "
            "mixture, or train on the others with data.allow_missing=True"
        )
    if absent := _without_folder(validation):
        problems.append(
            f"data sets to validate on without their folder: {_named(absent)}; give --validation_source=NAME=FOLDER "
            "(or none), or set validation.sources.NAME.root"
        )
    if problems:
        raise InputError("; ".join(problems))


def _without_folder(sources: Sequence[SourceConfig]) -> list[SourceConfig]:
    return [source for source in sources if source.root is not None and not Path(source.root).is_dir()]


def _named(sources: Sequence[SourceConfig]) -> str:
    return ", ".join(f"{source.name} ({source.root})" for source in sources)
