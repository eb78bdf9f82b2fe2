"""What a run's earlier validations found, by the lines of its metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from logvggt_jax.data.dataset import ConfidentDataset, Dataset
from logvggt_jax.training.config import VALIDATION_METRICS, TrainConfig
from logvggt_jax.weights.digests import json_digest

# Of the digest in the line of a validation.
VALIDATION_SET = "validation_set"


def validation_digest(config: TrainConfig, datasets: Sequence[Dataset] = ()) -> str:
    """Of what decides the clips of validation and their truth: its settings, but for when it is due and what is kept,
    and the teacher's where that labels them, as the `datasets` of validation then say.

    A set that was moved to another folder counts as another one: for some readers the folder is all that tells them
    apart.
    """
    settings = config.to_dict()
    chosen = {name: value for name, value in settings["validation"].items() if name not in ("every", "best")}
    teachers = [dataset.labelled_by for dataset in datasets if isinstance(dataset, ConfidentDataset)]
    # The teacher is the same wherever its weights lie.
    return json_digest([chosen, {**settings["teacher"], "weights": teachers} if teachers else None])


def validation_of(lines: Sequence[Mapping[str, Any]], step: int) -> Mapping[str, Any] | None:
    """The line of the validation of this step; None where there is none."""
    return next((line for line in lines if line["step"] == step and "validation/abs_rel" in line), None)


def is_best(
    lines: Sequence[Mapping[str, Any]],
    step: int,
    metric: str,
    values: Mapping[str, float | None],
    *,
    held: int | None,
    digest: str,
) -> bool:
    """Whether the metric's value of this step is better than that of the model that is `held`, of another step; None:
    of no one.

    Where nothing is known of that step, it has to be better than every validation before. What is no number is not.
    Values on other clips tell nothing: only lines with this `digest` count, and those of earlier versions, which have
    none, so that a model that was kept before does not give place to a worse one.
    """
    name = f"validation/{metric}"
    sign = 1.0 if VALIDATION_METRICS[metric] else -1.0
    known = {
        line["step"]: sign * line[name]
        for line in lines
        if line["step"] < step and line.get(name) is not None and line.get(VALIDATION_SET, digest) == digest
    }
    rivals = [] if held is None else [known[held]] if held in known else known.values()
    found = values.get(name)
    # A line has none for what is no number.
    return found is not None and math.isfinite(found) and sign * found > max(rivals, default=-math.inf)
