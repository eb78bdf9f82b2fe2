"""What a dry run says of a run: what a step needs, what its devices exchange, how many clips fit; and nothing more."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import pytest

from logvggt_jax.errors import InputError
from logvggt_jax.training import dry_run as module
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.dry_run import dry_run
from logvggt_jax.training.parallel.sharding import data_mesh
from logvggt_jax.training.step import costs
from logvggt_jax.training.step.costs import StepCosts, step_costs

ROOT = Path(__file__).parents[2]
SIZE = (28, 42)


@pytest.fixture
def config(monkeypatch: pytest.MonkeyPatch) -> TrainConfig:
    """`configs/tiny.py` with one stage of few small frames."""
    monkeypatch.syspath_prepend(str(ROOT))
    tiny = TrainConfig.from_dict(importlib.import_module("configs.tiny").get_config().to_dict())
    stage = dataclasses.replace(tiny.stages[0], clip_length=2, batch_size=4, sizes=(SIZE,))
    encoder = dataclasses.replace(tiny.model.encoder, depth=1, frozen=True)
    return dataclasses.replace(tiny, stages=(stage,), model=dataclasses.replace(tiny.model, encoder=encoder))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, layered: Any, layered_params: Any) -> list[tuple[int, ...]]:
    """Runs have a model that compiles at once; the clips whose operations, which are none of its, were asked for."""
    asked: list[tuple[int, ...]] = []
    monkeypatch.setattr(costs, "LogVGGT", lambda _: layered)
    monkeypatch.setattr(costs, "abstract_parameters", lambda _: jax.eval_shape(lambda: layered_params))
    monkeypatch.setattr(module, "step_flops", lambda _, clips, **__: asked.append(clips) or 3e12)
    return asked


@pytest.fixture
def tried(quick: list[tuple[int, ...]], monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of clips a device whose steps were asked for; each takes five bytes, and ten a clip."""
    asked: list[int] = []

    def given(config: TrainConfig, mesh: object, clips: int, clip_length: int, size: object) -> StepCosts:
        asked.append(clips)
        return StepCosts(5, 10 * clips, {}, 0.0)

    monkeypatch.setattr(module, "step_costs", given)
    return asked


def test_a_step_is_described_and_nothing_is_allocated(
    config: TrainConfig, quick: list[tuple[int, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[StepCosts | None] = []
    monkeypatch.setattr(module, "step_costs", lambda *given: found.append(step_costs(*given)) or found[-1])
    lines: list[str] = []
    before = len(jax.live_arrays())
    dry_run(config, data_mesh(2), lines.append)
    assert len(jax.live_arrays()) <= before
    assert "2 x cpu, memory not known" in lines[0]
    assert "28x42, 2 x 2 frames a device" in lines[1]
    assert quick == [(4, 2, *SIZE)]
    for word in (": 3 TFLOP in all", "arguments", "temporaries", "all-reduce", "compiled in"):
        assert word in lines[1]
    assert "is not known" in lines[2], "a CPU does not say how much memory a program may use"

    (step,) = found
    assert step is not None
    params = costs.abstract_parameters(config.model)
    size = {name: sum(4 * leaf.size for leaf in jax.tree.leaves(tree)) for name, tree in params.items()}
    trained = sum(size.values()) - size["encoder"]
    exchanged = sum(total for _, total in step.collectives.values())
    # A compiler may leave out sums of what is zero everywhere, of the frozen encoder; there are numbers for the log.
    assert trained <= exchanged < sum(size.values()) + 1_000
    assert step.arguments > sum(size.values()) + 2 * trained, "parameters, two moments, a batch"


@pytest.mark.parametrize(
    ("limit", "answer"), [(45, "4 is the largest of 1, 2, 4, 8 clips"), (5, "none of 1, 2, 4, 8 clips"), (1000, "8 is")]
)
def test_the_largest_that_fits_is_searched(
    config: TrainConfig, tried: list[int], limit: int, answer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "device_bytes", lambda device: limit)
    lines: list[str] = []
    dry_run(config, data_mesh(2), lines.append)
    assert answer in lines[-1]
    # The stage's own 2 clips a device are not compiled again.
    assert tried == [2, *[clips for clips in (1, 4, 8) if clips == 1 or 5 + 10 * (clips // 2) <= limit]]
    assert ("which do not fit" in lines[1]) == (limit < 25)


def test_clips_that_are_accumulated_are_tried_in_whole_parts(
    config: TrainConfig, tried: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "device_bytes", lambda device: 65)
    lines: list[str] = []
    dry_run(dataclasses.replace(config, accumulate=2), data_mesh(2), lines.append)
    assert tried == [2, 4, 8] and "4 is the largest of 2, 4, 8, 16 clips a device" in lines[-1]


def test_batches_have_to_split_over_the_devices(config: TrainConfig) -> None:
    with pytest.raises(InputError, match="batch_size=4 does not split over 3 devices"):
        dry_run(config, data_mesh(3))


def test_described_devices_have_their_own_attention_and_memory(
    config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds: list[str] = []

    def given(config: TrainConfig, mesh: object, clips: int, *_: object) -> StepCosts:
        kinds.append(config.model.attention)
        return StepCosts(5, 10 * clips, {}, 0.0)

    @contextlib.contextmanager
    def kernels(device: jax.Device) -> Iterator[str]:
        yield "cudnn"

    monkeypatch.setattr(module, "step_costs", given)
    monkeypatch.setattr(module, "attention_kernels", kernels)
    monkeypatch.setattr(module, "described_bytes", lambda device: 45)
    lines: list[str] = []
    dry_run(config, data_mesh(2), lines.append)
    assert set(kinds) == {"cudnn"}
    assert "4 is the largest of 1, 2, 4, 8 clips" in lines[-1]


def test_a_mesh_is_made_of_described_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "described_devices", lambda name: jax.devices()[: int(name)])
    assert module.described_mesh("2").shape == {"data": 2}
