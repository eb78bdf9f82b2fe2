"""Whether all processes of a run were started with one command."""

from __future__ import annotations

import json
from typing import Any

import jax
import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.agreement import check_agreement, texts_from_all
from logvggt_jax.training.parallel.setting_differences import (
    differences,
    first_of,
    what_decides_clips,
    what_decides_labels,
)


def check_same_settings(config: TrainConfig, **flags: Any) -> None:
    """Raises InputError, on every process, naming the settings and `flags` (JSON types) in which one differs from
    process 0: their copies of the parameters would part, and they would wait for one another in different programs.

    Where files lie and how they are read may differ from machine to machine. All processes have to ask at the same
    point.
    """
    if jax.process_count() == 1:
        return
    texts = texts_from_all(json.dumps({"config": _shared(config.to_dict()), **flags}))
    first, *others = map(json.loads, texts)
    for process, other in enumerate(others, 1):
        found = [
            f"{name.removeprefix('.')}={theirs!r}, there {ours!r}"
            for name, ours, theirs in differences(first, other, "")
        ]
        if found:
            raise InputError(
                f"process {process} was started with other settings than process 0: {first_of(found)}; start all with "
                "one command"
            )


def check_same_parameters(params: Any) -> None:
    """Raises InputError, on every process, unless all of them have these initial parameters, numpy arrays; by the sums
    of the leaves. All processes have to ask at the same point."""
    if jax.process_count() == 1:
        return
    sums = [float(np.asarray(leaf).sum(dtype=np.float64)) for leaf in jax.tree.leaves(params)]
    check_agreement("the initial parameters", sums, mend="give all the same file as --config.initial_weights")


def _shared(config: dict[str, Any]) -> dict[str, Any]:
    """The settings without those that are of one machine."""
    kept = {name: value for name, value in config.items() if name != "initial_weights"}
    kept |= {"data": what_decides_clips(config["data"]), "teacher": what_decides_labels(config["teacher"])}
    if (validation := config["validation"]) is not None:
        anywhere = [{name: x for name, x in source.items() if name != "root"} for source in validation["sources"]]
        kept["validation"] = {**validation, "sources": anywhere}
    return kept
