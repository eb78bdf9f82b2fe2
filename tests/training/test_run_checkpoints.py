"""Position and settings of a run's checkpoints have a digest, and models of others are never replaced."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from logvggt_jax.config import from_mapping
from logvggt_jax.errors import InputError, OutputExists
from logvggt_jax.training.checkpoints import Position, RunCheckpoints
from logvggt_jax.training.config import OptimizerConfig, TrainConfig
from logvggt_jax.training.optimizer import make_optimizer
from logvggt_jax.training.state import TrainState, initial_state
from logvggt_jax.weights import Provenance, save_model

POSITION = Position(1, {"next_index": 12, "sampler": {"seed": 5, "epoch": 2}})


@pytest.fixture
def state(optimizer_config: OptimizerConfig) -> TrainState:
    params = {"camera_head": {"kernel": np.ones((3, 4), np.float32)}}
    state = initial_state(params, make_optimizer(optimizer_config, params, frozen=()))
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.device_put(state, here)


@pytest.fixture
def saved(run_config: TrainConfig, state: TrainState, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run's folder with one checkpoint, of step 0; its model folder does not matter here."""
    monkeypatch.setattr("logvggt_jax.training.checkpoints.save_model", lambda *_: None)
    monkeypatch.setattr("logvggt_jax.training.checkpoints.unstack_layers", lambda tree, *_: tree)
    with RunCheckpoints(tmp_path / "run", run_config) as checkpoints:
        checkpoints.save(state, POSITION)
    return tmp_path / "run"


def _restore(folder: Path, config: TrainConfig, state: TrainState) -> tuple[TrainState, Position]:
    with RunCheckpoints(folder, config) as checkpoints:
        return checkpoints.restore(state)


def _edit(file: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


@pytest.mark.parametrize("part", ["data", "meta"])
def test_flipped_bits_of_position_and_settings_are_noticed(
    run_config: TrainConfig, state: TrainState, saved: Path, part: str
) -> None:
    file = saved / "checkpoints" / "0" / part / "metadata"
    good = file.read_bytes()
    noticed = 0
    with RunCheckpoints(saved, run_config) as checkpoints:
        for bit in range(0, 8 * len(good), max(1, 8 * len(good) // 60)):
            flipped = bytearray(good)
            flipped[bit // 8] ^= 1 << bit % 8
            file.write_bytes(flipped)
            try:
                position = checkpoints.restore(state)[1]
            except InputError as error:
                assert "checkpoint of step 0 in" in str(error) and "\n" not in str(error)
                noticed += 1
            else:
                assert position == POSITION and json.loads(flipped) == json.loads(good)
    assert noticed > 30


def test_a_changed_position_and_a_changed_setting_are_refused(
    run_config: TrainConfig, state: TrainState, saved: Path
) -> None:
    assert _restore(saved, run_config, state)[1] == POSITION
    changes: tuple[tuple[str, Callable[[dict[str, Any]], Any]], ...] = (
        ("data", lambda data: data.update(next_index=13)),
        ("meta", lambda meta: meta.update(stage=0)),
        ("meta", lambda meta: meta["config"].update(log_every=7)),
    )
    for part, change in changes:
        copy = saved.with_name("copy")
        shutil.copytree(saved, copy)
        _edit(copy / "checkpoints" / "0" / part / "metadata", change)
        with pytest.raises(InputError, match=r"step 0 .*damaged: position and settings differ.*start a new --workdir"):
            _restore(copy, run_config, state)
        shutil.rmtree(copy)


def test_a_checkpoint_from_before_the_digest_is_restored(
    run_config: TrainConfig, state: TrainState, saved: Path
) -> None:
    _edit(saved / "checkpoints" / "0" / "meta" / "metadata", lambda meta: meta.pop("digest"))
    assert _restore(saved, run_config, state)[1] == POSITION


def test_the_model_folder_says_how_it_was_trained(
    run_config: TrainConfig, state: TrainState, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Provenance] = []
    monkeypatch.setattr("logvggt_jax.training.checkpoints.save_model", lambda *saved: written.append(saved[3]))
    monkeypatch.setattr("logvggt_jax.training.checkpoints.unstack_layers", lambda tree, *_: tree)
    with RunCheckpoints(tmp_path / "run", run_config) as checkpoints:
        checkpoints.save(state, POSITION)
    training = from_mapping(Provenance, json.loads(json.dumps(written[0].to_dict())), "provenance").training
    assert training is not None and training.configuration is not None
    assert TrainConfig.from_dict(training.configuration) == run_config
    assert training.steps == 0 and training.device == f"{jax.device_count()} x cpu"
    assert training.data == "rooms (train)"


def test_a_model_that_the_run_did_not_write_is_never_replaced(
    run_config: TrainConfig, small_config: Any, small_variables: dict[str, Any], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    save_model(run / "model", small_config, small_variables["params"], Provenance("vggt", 518, None, "VGGT checkpoint"))
    with pytest.raises(OutputExists, match=r"run/model: a model that this run did not write \(VGGT checkpoint\)"):
        RunCheckpoints(run, run_config)
    assert [entry.name for entry in run.iterdir()] == ["model"]
    # A run that was killed before its first checkpoint was complete goes on.
    source = f"trained from random parameters in {run}"
    save_model(run / "model", small_config, small_variables["params"], Provenance("windows", 42, None, source))
    with RunCheckpoints(run, run_config) as checkpoints:
        assert checkpoints.steps == []
