"""What a run's earlier validations found, by the lines of its metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from logvggt_jax.training.config import VALIDATION_METRICS


def is_validated(lines: Sequence[Mapping[str, Any]], step: int) -> bool:
    """Whether there is a validation of this step."""
    return any(line["step"] == step and "validation/abs_rel" in line for line in lines)


def is_best(
    lines: Sequence[Mapping[str, Any]], step: int, metric: str, values: Mapping[str, float], held: int | None
) -> bool:
    """Whether the metric's value of this step is better than that of the model that is `held`, of another step; None:
    of no one.

    Where nothing is known of that step, it has to be better than every validation before. What is no number is not.
    """
    name = f"validation/{metric}"
    sign = 1.0 if VALIDATION_METRICS[metric] else -1.0
    known = {line["step"]: sign * line[name] for line in lines if line["step"] < step and line.get(name) is not None}
    rivals = [] if held is None else [known[held]] if held in known else known.values()
    return math.isfinite(values[name]) and sign * values[name] > max(rivals, default=-math.inf)
