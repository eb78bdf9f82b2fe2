"""The files under `configs/`: each builds its run, and the largest one's whole step is checked on shapes."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import math
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.data.feeding.holdouts import PUBLISHED
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.optimizer import learning_rate_schedule, make_optimizer
from logvggt_jax.training.sharding import check_batch_size, data_mesh
from logvggt_jax.training.state import initial_state
from logvggt_jax.training.step import make_loss_terms, make_train_step

ROOT = Path(__file__).parents[1]


def _config(name: str, monkeypatch: pytest.MonkeyPatch) -> TrainConfig:
    monkeypatch.syspath_prepend(str(ROOT))
    return TrainConfig.from_dict(importlib.import_module(f"configs.{name}").get_config().to_dict())


@pytest.mark.parametrize("name", ["tiny", "demo", "h20"])
def test_configuration_builds_its_run(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config(name, monkeypatch)
    schedule = learning_rate_schedule(config.optimizer, config.stages)
    rates = [float(schedule(step)) for step in range(0, config.total_steps, max(config.total_steps // 200, 1))]
    assert max(rates) == pytest.approx(config.optimizer.learning_rate, rel=1e-2)
    assert all(height % 14 == 0 == width % 14 for stage in config.stages for height, width in stage.sizes)


def test_rooms_start_at_their_mean_field_of_view(monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config("tiny", monkeypatch)
    rooms = Rooms("train", **{**dict(config.data.sources[0].options), "num_rooms": 40})
    focal = [rooms.room(name).focal for name in rooms.sequences]
    mean = 2 * math.atan(0.5 / (sum(focal) / len(focal)))
    assert config.model.camera_head.initial_pose[8] == pytest.approx(mean, abs=0.05)


def test_training_and_validation_share_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config("tiny", monkeypatch)
    assert config.validation is not None
    sources = (*config.data.sources, config.validation.source)
    train, held_out = (set(Rooms(source.split, **dict(source.options)).sequences) for source in sources)
    assert not train & held_out


def test_h20_is_the_papers_training(monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config("h20", monkeypatch)
    assert config.model == ModelConfig(dtype="bfloat16")
    assert [(stage.clip_length, stage.steps) for stage in config.stages] == [(12, 100 * 800), (64, 10 * 800)]
    assert len(config.data.sources) == 11
    assert not {source.name for source in config.data.sources} & {"rooms", "seven_scenes", "nrgbd", "sintel", "bonn"}
    assert dict(config.data.hold_out) == PUBLISHED, "what evaluation uses is not trained on"
    assert not config.data.allow_missing
    strides = {source.name: source.stride for source in config.data.sources}
    assert [name for name, stride in strides.items() if stride is None] == ["blendedmvs"], "the only unordered set"
    for stage in config.stages:
        check_batch_size(stage, data_mesh(16))


def test_h20_step_holds_together_on_sixteen_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole step of VGGT-1B's sizes on abstract values: shapes, types and shardings, no numbers."""
    config = _config("h20", monkeypatch)
    model, mesh, frames = LogVGGT(config.model), data_mesh(16), 2
    height, width = config.stages[0].sizes[-1]
    shapes = {
        "images": jax.ShapeDtypeStruct((16, frames, height, width, 3), jnp.uint8),
        "depth": jax.ShapeDtypeStruct((16, frames, height, width), jnp.float32),
        "intrinsics": jax.ShapeDtypeStruct((16, frames, 3, 3), jnp.float32),
        "extrinsics": jax.ShapeDtypeStruct((16, frames, 4, 4), jnp.float32),
    }
    params = jax.eval_shape(model.init, jax.random.key(0), shapes["images"])["params"]
    assert 1.1e9 < sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(params)) < 1.3e9
    optimizer = make_optimizer(config.optimizer, params, frozen=("encoder",))
    state = jax.eval_shape(functools.partial(initial_state, optimizer=optimizer), params)
    moments = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(state.opt_state))
    modules = [tree for name, tree in params.items() if name != "encoder"]
    trained = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(modules))
    assert 2 * trained <= moments < 2 * trained + 100, "two moments for what is trained, none for the encoder"
    schedule = learning_rate_schedule(config.optimizer, config.stages)
    step = make_train_step(make_loss_terms(model, config.loss), config.loss, optimizer, schedule, mesh)
    after, metrics = jax.eval_shape(step, state, shapes)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert all(value.shape == () for value in metrics.values())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--config.optimizer.learning_rat=1"], "learning_rat"),
        (["--config.loss.name=huber"], "loss.name must be one of"),
        (["--config=configs/none.py"], "configs/none.py"),
    ],
)
def test_command_line_mistakes_are_one_line(arguments: list[str], message: str, tmp_path: Path) -> None:
    command = [sys.executable, "train.py", "--config=configs/tiny.py", f"--workdir={tmp_path / 'run'}", *arguments]
    finished = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert finished.returncode != 0
    assert message in finished.stderr
    assert "Traceback" not in finished.stderr
    assert not (tmp_path / "run").exists()


def test_frozen_encoder_is_configured_by_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _config("h20", monkeypatch).model.encoder.frozen
    assert not _config("tiny", monkeypatch).model.encoder.frozen
    assert dataclasses.replace(ModelConfig().encoder, frozen=False) != ModelConfig().encoder
