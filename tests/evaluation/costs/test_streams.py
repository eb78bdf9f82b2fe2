"""Costs of methods by length: what is run and kept, with stand-ins for predictors."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.evaluation.costs import streams
from logvggt_jax.evaluation.costs.streams import (
    TimingConfig,
    cost_of_length,
    median_rate,
    random_pictures,
    unlimited_settings,
)
from logvggt_jax.evaluation.costs.throughput import measured_costs
from logvggt_jax.evaluation.methods.method import Method
from logvggt_jax.streaming import CausalSettings, MergedSettings, PredictionError


class Keeper:
    """Keeps three frames' worth of ten bytes, and refuses a seventh frame."""

    def __init__(self, *, compiles: bool = False) -> None:
        self.count, self._compiles = 0, compiles

    @property
    def state_bytes(self) -> int:
        return 10 * min(self.count, 3)

    def push(self, frame: np.ndarray) -> list[Any]:
        self.count += 1
        if self._compiles:
            jax.jit(lambda x: x + 1)(jnp.zeros(self.count))
        if self.count > 6:
            raise PredictionError("too long")
        return [frame]

    def close(self) -> list[Any]:
        self.count = 0
        return []

    def cameras(self) -> None:
        return None


def row(name: str, **options: bool) -> Method:
    return Method(name, "nothing", predict=None, identity=[name], start=lambda: Keeper(**options))  # type: ignore[arg-type, return-value]


PICTURES = random_pictures((14, 28))


def test_a_cost_has_rates_and_the_most_that_was_kept() -> None:
    cost = cost_of_length(row("a"), PICTURES, 5, rounds=3)
    assert len(cost["frames_per_second"]) == 3 and cost["state_bytes"] == 30 and cost["compilations"] == 0
    assert median_rate(cost) == sorted(cost["frames_per_second"])[1]
    assert cost_of_length(row("a"), PICTURES, 2, rounds=1)["state_bytes"] == 20
    assert cost_of_length(row("a"), PICTURES, 7, rounds=1) == {"reason": "too long"}
    assert median_rate({"reason": "too long"}) is None


def test_a_method_is_timed_on_any_number_of_frames() -> None:
    assert unlimited_settings("merged") == MergedSettings(max_frames=None) != MergedSettings()
    assert unlimited_settings("causal") == CausalSettings()


def test_programs_made_after_the_first_run_are_counted() -> None:
    assert cost_of_length(row("a", compiles=True), PICTURES, 4, rounds=2)["compilations"] >= 2 * 4


def test_costs_are_measured_once_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, config = [row("a"), row("b")], TimingConfig(lengths=(7, 2), rounds=1)

    def measure(**changed: Any) -> dict[str, Any]:
        given: dict[str, Any] = {"rows": rows, "image_size": (14, 28), "dtype": "float32", **changed}
        return measured_costs(given.pop("rows"), config, tmp_path, **given)

    report = measure()
    assert report["lengths"] == [2, 7] and report["image_size"] == [14, 28]
    assert {name: set(costs) for name, costs in report["costs"].items()} == {"a": {"2", "7"}, "b": {"2", "7"}}
    assert report["costs"]["b"]["7"] == {"reason": "too long"}

    def again(*_: object) -> None:
        raise AssertionError("measured again")

    monkeypatch.setattr(streams, "cost_of_length", again)
    assert measure() == report
    for changed in (
        {"fresh": True},
        {"dtype": "bfloat16"},
        {"rows": [rows[0], dataclasses.replace(rows[1], identity=["other"])]},
    ):
        with pytest.raises(AssertionError, match="measured again"):
            measure(**changed)
