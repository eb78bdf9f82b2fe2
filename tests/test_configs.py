"""The files under `configs/`: each builds its run, and the largest one's whole step is checked on shapes."""

import dataclasses
import functools
import importlib
import inspect
import math
import operator
import os
import re
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import pytest
from ml_collections import ConfigDict
from root_programs import RootPrograms

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.data.feeding.holdouts import PUBLISHED
from logvggt_jax.data.rooms.pool import render_pool
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.described import cudnn_by_description
from logvggt_jax.doctor import training as doctors_step
from logvggt_jax.errors import InputError, MissingInput
from logvggt_jax.evaluation.datasets import open_evaluation_set
from logvggt_jax.evaluation.settings import ClipRun, read_run
from logvggt_jax.streaming import METHODS, AnchoredWindowSettings, CausalSettings, PrunedSettings
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.sharding import check_batch_size, data_mesh
from logvggt_jax.training.step.costs import abstract_clips
from logvggt_jax.training.step.optimizer import learning_rate_schedule
from logvggt_jax.training.step.program import abstract_parameters, make_program
from logvggt_jax.training.step.state import TrainState
from logvggt_jax.training.validation.validation import clip_starts
from logvggt_jax.weights.address import resolve
from logvggt_jax.weights.checkpoints import read_config, save_model
from logvggt_jax.weights.folder import write_description
from logvggt_jax.weights.provenance import Provenance

ROOT = Path(__file__).parents[1]


def _config(name: str, monkeypatch: pytest.MonkeyPatch) -> TrainConfig:
    monkeypatch.syspath_prepend(str(ROOT))
    return TrainConfig.from_dict(importlib.import_module(f"configs.{name}").get_config().to_dict())


@pytest.mark.parametrize("name", ["tiny", "demo", "rooms", "small", "h20", "finetune", "distill", "distill_rooms"])
def test_configuration_builds_its_run(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config(name, monkeypatch)
    schedule = learning_rate_schedule(config.optimizer, config.stages)
    rates = [float(schedule(step)) for step in range(0, config.total_steps, max(config.total_steps // 200, 1))]
    assert max(rates) == pytest.approx(config.optimizer.learning_rate, rel=1e-2)
    assert all(height % 14 == 0 == width % 14 for stage in config.stages for height, width in stage.sizes)


@pytest.mark.parametrize("name", ["tiny", "small"])
def test_rooms_start_at_their_mean_field_of_view(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config(name, monkeypatch)
    rooms = Rooms("train", **{**dict(config.data.sources[0].options), "num_rooms": 40})
    focal = [rooms.room(name).focal for name in rooms.sequences]
    mean = sum(focal) / len(focal)
    height, width = config.stages[0].sizes[0]
    expected = (2 * math.atan(height / width / 2 / mean), 2 * math.atan(0.5 / mean))
    assert config.model.camera_head.initial_pose[7:] == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("name", ["tiny", "small"])
def test_training_and_validation_share_no_room(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config(name, monkeypatch)
    assert config.validation is not None
    sources = (*config.data.sources, *config.validation.sources)
    train, held_out = (set(Rooms(source.split, **dict(source.options)).sequences) for source in sources)
    assert not train & held_out


def test_the_small_model_fits_the_package_and_is_the_papers_method(monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config("small", monkeypatch)
    parameters = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(abstract_parameters(config.model)))
    assert parameters > 4.5e6 and 2 * parameters < 12e6, "bytes at 16 bits"
    assert config.model.windows == ModelConfig().windows and config.loss.name == "log_vggt"
    assert config.model.refinement == dataclasses.replace(ModelConfig().refinement, num_heads=4)
    assert [stage.clip_length for stage in config.stages] == [4, 12, 32]
    assert {stage.sizes for stage in config.stages} == {((168, 224),)}
    rooms = Rooms("train", **dict(config.data.sources[0].options))
    assert rooms.renderer == "device"
    long = config.stages[-1]
    assert (long.clip_length - 1) * long.max_stride < rooms.num_frames(rooms.sequences[0]), "every clip finds its room"
    assert (long.clip_length - 1) * (long.min_stride + long.max_stride) / 2 > rooms.period, "most clips close a loop"


@pytest.mark.slow
def test_the_small_models_step_is_traced_at_its_shortest_and_longest_clips(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = _config("small", monkeypatch)
    state, step = _abstract_run(config, 1)
    for stage in (config.stages[0], config.stages[-1]):
        after, metrics, _ = jax.eval_shape(step, state, abstract_clips(stage.batch_size, stage.clip_length, (168, 224)))
        assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
        assert all(value.shape == () for value in metrics.values())


def _trained_on(name: str, whole: TrainConfig) -> TrainConfig:
    more = TrainConfig.from_dict(importlib.import_module(f"configs.{name}").get_config("rooms").to_dict())
    assert more.initial_weights == "rooms" and whole.initial_weights is None
    assert more.optimizer.learning_rate < whole.optimizer.learning_rate
    return more


def test_the_small_model_goes_on_from_weights_with_its_last_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = _config("small", monkeypatch)
    more = _trained_on("small", whole)
    assert more.stages == (dataclasses.replace(whole.stages[-1], steps=4000),)
    assert more.model == whole.model


def test_a_model_of_rooms_goes_on_from_weights_at_their_sizes_with_both_lengths_in_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = _config("rooms", monkeypatch)
    more = _trained_on("rooms", whole)
    assert more.model == read_config(resolve("rooms"))
    assert [stage.clip_length for stage in more.stages] == 15 * [12, 32]
    assert len({stage.steps for stage in more.stages}) == 1
    assert {stage.sizes for stage in more.stages} == {whole.stages[0].sizes}
    rooms = [Rooms("train", **dict(config.data.sources[0].options)) for config in (whole, more)]
    assert len(rooms[1].sequences) > len(rooms[0].sequences)


@pytest.mark.parametrize("name", ["rooms", "small"])
def test_weights_go_on_with_rooms_of_their_own(
    name: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    small_config: ModelConfig,
    small_variables: dict[str, Any],
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    get_config = importlib.import_module(f"configs.{name}").get_config
    save_model(tmp_path / "other", small_config, small_variables["params"])
    first, shipped, again, other = (
        get_config(weights).data.sources.rooms.options for weights in ("", "rooms", "rooms", str(tmp_path / "other"))
    )
    assert shipped.seed == again.seed
    assert len({first.seed, shipped.seed, other.seed}) == 3
    assert first.facing_north == 0.5 and shipped.facing_north == other.facing_north == 0.0


@pytest.mark.parametrize(
    ("name", "arguments"),
    [*((name, ()) for name in ("tiny", "demo", "rooms", "small", "distill_rooms")), ("rooms", ("rooms",))],
)
def test_rooms_that_are_kept_in_memory_fit_there(
    name: str, arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    config = importlib.import_module(f"configs.{name}").get_config(*arguments)
    data = TrainConfig.from_dict(config.to_dict()).data
    rooms = Rooms("train", **dict(data.sources[0].options))
    frames = len(rooms.sequences) * rooms.num_frames(rooms.sequences[0])
    in_memory = data.cache_dir is None and rooms.renderer == "host"
    most = inspect.signature(render_pool).parameters["max_bytes"].default
    assert not in_memory or 7 * frames * math.prod(rooms.image_size(rooms.sequences[0])) < most


def test_what_ships_is_trained_on_by_a_script() -> None:
    script = ["scripts/train_small.sh", "--config.max_minutes=120"]
    shown = subprocess.run(script, cwd=ROOT, env={**os.environ, "PYTHON": "echo"}, capture_output=True, text=True)
    words = shown.stdout.split()
    assert words[:2] == ["train.py", "--config=configs/rooms.py:rooms"] and words[-1] == script[-1]


def test_a_student_of_rooms_differs_from_the_half_hour_run_in_what_it_is_told_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told, taught = (_config(name, monkeypatch) for name in ("tiny", "distill_rooms"))
    assert taught.teacher is not None and taught.loss == dataclasses.replace(told.loss, name="distillation")
    assert (taught.model, taught.optimizer, taught.data.sources) == (told.model, told.optimizer, told.data.sources)
    for stage, alike in zip(taught.stages, told.stages, strict=True):
        assert dataclasses.replace(stage, max_stride=alike.max_stride) == alike
        assert (stage.clip_length - 1) * stage.max_stride < taught.teacher.clip_length, "lies within its teacher's"


def test_finetuning_takes_sizes_and_pictures_from_the_model_it_starts_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_config: ModelConfig
) -> None:
    vggt = _config("finetune", monkeypatch)
    assert vggt.model == ModelConfig(dtype="bfloat16") and vggt.stages[0].sizes[0] == (392, 518)
    (tmp_path / "model").mkdir()
    known = {"config": small_config.to_dict(), "digests": {}, "provenance": Provenance("windows", 70).to_dict()}
    write_description(tmp_path / "model", known)
    own = TrainConfig.from_dict(importlib.import_module("configs.finetune").get_config(str(tmp_path)).to_dict())
    assert own.model == small_config and own.initial_weights == str(tmp_path)
    assert own.stages[0].sizes == ((56, 70), (42, 70), (70, 56), (70, 42))
    assert own.optimizer.learning_rate > vggt.optimizer.learning_rate
    for edge, sizes in ((42, ((28, 42), (42, 28))), (14, ((14, 14),))):
        write_description(tmp_path / "model", {**known, "provenance": Provenance("windows", edge).to_dict()})
        small = importlib.import_module("configs.finetune").get_config(str(tmp_path))
        assert TrainConfig.from_dict(small.to_dict()).stages[0].sizes == sizes
    (tmp_path / "converted").mkdir()
    known = {"config": ModelConfig().to_dict(), "digests": {}, "provenance": Provenance("vggt", 518).to_dict()}
    write_description(tmp_path / "converted", known)
    converted = importlib.import_module("configs.finetune").get_config(str(tmp_path / "converted"))
    assert TrainConfig.from_dict(converted.to_dict()).model == vggt.model, "stored in float32, trained in bfloat16"
    trained, validated = own.data.sources[0], own.validation.sources[0]
    assert (trained.frames, validated.frames) == ((None, -200), (-200, None)), "what is validated is not trained on"


def test_the_clips_of_validation_fit_the_shortest_recording_that_the_page_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    page = (ROOT / "docs/own-sequences.md").read_text()
    found = re.search(r"a short recording may have room for no more than `:-(\d+)` and `-(\d+):`", page)
    assert found is not None and found[1] == found[2]
    settings = _config("finetune", monkeypatch).validation
    assert settings is not None
    recording: Any = SimpleNamespace(sequences=["walk"], num_frames=lambda _: int(found[1]))
    assert len(clip_starts("tum_recording", recording, settings)) == settings.num_clips


def test_finetuning_goes_on_from_its_own_folder_where_its_first_weights_are_gone(
    tmp_path: Path, small_config: ModelConfig
) -> None:
    def config(start: Path) -> TrainConfig:
        return TrainConfig.from_dict(importlib.import_module("configs.finetune").get_config(str(start)).to_dict())

    start, workdir = tmp_path / "start", tmp_path / "run"
    for folder in (start, workdir / "model"):
        folder.mkdir(parents=True)
        known = {"config": small_config.to_dict(), "digests": {}, "provenance": Provenance("windows", 70).to_dict()}
        write_description(folder, known)
    begun, goes_on = config(start), config(workdir)
    assert dataclasses.replace(goes_on, initial_weights=begun.initial_weights) == begun
    with pytest.raises(MissingInput, match=r"gone: no such file .* give its --workdir after the colon"):
        config(tmp_path / "gone")


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


@pytest.mark.parametrize("stage", ["stage_1", "stage_2"])
def test_each_of_the_papers_stages_can_be_trained_alone(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, alone = _config("h20", monkeypatch), importlib.import_module("configs.h20").get_config(f"/data,{stage}")
    found = TrainConfig.from_dict(alone.to_dict())
    assert found.stages == tuple(each for each in whole.stages if each.name == stage)
    assert found.data.sources[0].root.startswith("/data/")
    with pytest.raises(InputError, match=r"has stages stage_1, stage_2, got 'stage_3'"):
        importlib.import_module("configs.h20").get_config("/data,stage_3")


def _abstract_run(config: TrainConfig, num_devices: int) -> tuple[TrainState, jax.stages.Wrapped]:
    """A run's first state without values, and its step."""
    params = abstract_parameters(config.model)
    program = make_program(LogVGGT(config.model), config, params, data_mesh(num_devices))
    return program.abstract_state, program.step


def _shallow(config: TrainConfig) -> TrainConfig:
    """The run with one layer in each stack (four in the aggregator, for the depth head); all widths are as they are."""
    model = dataclasses.replace(
        config.model,
        encoder=dataclasses.replace(config.model.encoder, depth=1),
        aggregator=dataclasses.replace(config.model.aggregator, depth=4, key_layers=(0, 1, 2, 3)),
        camera_head=dataclasses.replace(config.model.camera_head, depth=1),
    )
    return dataclasses.replace(config, model=model)


def test_doctor_times_the_step_of_h20(monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config("h20", monkeypatch)
    assert (config.loss, config.optimizer) == (doctors_step.LOSS, doctors_step.OPTIMIZER)


def test_h20_trains_all_but_the_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    state, _ = _abstract_run(_config("h20", monkeypatch), 16)
    assert 1.1e9 < sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(state.params)) < 1.3e9
    moments = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(state.opt_state))
    modules = [tree for name, tree in state.params.items() if name != "encoder"]
    trained = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(modules))
    assert 2 * trained <= moments < 2 * trained + 100, "two moments for what is trained, none for the encoder"


FAST_ATTENTION = {
    # The platform, and how its programs name the kernel's forward and backward calls.
    "cudnn": ("cuda", "@__cudnn$fmhaSoftmax(", "@__cudnn$fmhaSoftmaxBackward("),
    "tpu_flash": ("tpu", '"_flash_attention_kernel"', '"_flash_attention_dq_kernel"'),
}


@pytest.mark.parametrize(
    ("attention", "stage", "size"),
    # Sizes with an odd number of tokens, 1,041 and 893.
    [
        ("cudnn", 0, (392, 518)),
        pytest.param("cudnn", 1, (336, 518), marks=pytest.mark.slow),
        pytest.param("tpu_flash", 0, (392, 518), marks=pytest.mark.slow),
    ],
)
def test_h20_step_is_lowered_with_fast_attention(
    attention: str, stage: int, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    _check_step(_shallow(_config("h20", monkeypatch)), attention, stage, size, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("attention", ["cudnn", "tpu_flash"])
@pytest.mark.parametrize("depth", ["shallow", "full"])
def test_h20_step_is_lowered_with_fast_attention_at_all_sizes(
    attention: str, depth: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = _config("h20", monkeypatch)
    for index, stage in enumerate(config.stages):
        for size in stage.sizes if depth == "shallow" else stage.sizes[:1]:
            _check_step(_shallow(config) if depth == "shallow" else config, attention, index, size, monkeypatch)
            jax.clear_caches()


def _check_step(
    config: TrainConfig, attention: str, stage_index: int, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole step on sixteen devices, abstract values: shapes and types, and every large attention fast."""

    def refuse(*_: object) -> None:
        raise AssertionError("attention takes its general form")

    monkeypatch.setattr("logvggt_jax.model.attention._blockwise", refuse)
    platform, forward, backward = FAST_ATTENTION[attention]
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, attention=attention))
    state, step = _abstract_run(config, 16)
    stage = config.stages[stage_index]
    # JAX would ask the GPU at hand, which may be none.
    with cudnn_by_description():
        traced = step.trace(state, abstract_clips(stage.batch_size, stage.clip_length, size))
        program = traced.lower(lowering_platforms=(platform,)).as_text()
    after, metrics, _ = traced.out_info
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert all(value.shape == () for value in metrics.values())
    # Tables of positions and of interpolation are made by the program, of a row or column each: as constants, those of
    # one size were 250 MB of its text.
    assert max(map(len, program.splitlines())) < 300_000
    # Layers and windows are loops, so that a kernel is in the program a few times and runs many: attention of a frame
    # and of a window with its cache at least.
    assert program.count(backward) >= 2 and program.count(forward) >= 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--config.optimizer.learning_rat=1"], "learning_rat"),
        (["--config.loss.name=huber"], "loss.name must be one of"),
        (["--config=configs/none.py"], "train.py: --config=configs/none.py: No such file or directory\n"),
        (["--config.optimizer.frozen=('agregator/*',)"], "no parameter matches 'agregator/*'"),
        (["--config.initial_weights=runs/none/model"], "runs/none/model: no such file or folder"),
        (["--config.initial_weights=rooms"], "initial_weights=rooms: aggregator/camera_token has shape"),
        (["--resume_step=7"], "no checkpoint of step 7; there are none"),
    ],
)
def test_command_line_mistakes_are_one_line(
    programs: RootPrograms, arguments: list[str], message: str, tmp_path: Path
) -> None:
    finished = programs("train.py", "--config=configs/tiny.py", f"--workdir={tmp_path / 'run'}", *arguments)
    assert finished.returncode != 0 and message in finished.stderr
    # Before data are drawn, which is told, too.
    assert finished.stderr.count("\n") == 1 and not (tmp_path / "run").exists()


OPTIONAL = {
    "validation.best": "rotation",
    "loss.quantile": 0.98,
    "model.refinement.max_registers": 64,
    "model.aggregator.layer_scale": 0.5,
    "data.cache_dir": "/tmp/kept",
    "average": 0.999,
    "max_minutes": 8.0,
    "initial_weights": "rooms",
}


def _type_on_the_command_line(values: ConfigDict, field: str) -> type:
    """As what a flag for this field is read; there is none for a None that no placeholder stands for."""
    *parents, name = field.split(".")
    holder = functools.reduce(operator.getitem, parents, values)
    return holder.get_type(name)


@pytest.mark.parametrize("name", ["tiny", "demo", "rooms", "small", "h20", "finetune", "distill", "distill_rooms"])
def test_fields_that_a_file_leaves_out_can_be_changed_on_the_command_line(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    values = importlib.import_module(f"configs.{name}").get_config()
    before = TrainConfig.from_dict(values.to_dict())
    values.lock()
    for field, value in OPTIONAL.items():
        assert _type_on_the_command_line(values, field) is type(value), field
    values.update_from_flattened_dict(OPTIONAL)
    changed = TrainConfig.from_dict(values.to_dict())
    assert changed != before
    for field, value in OPTIONAL.items():
        assert operator.attrgetter(field)(changed) == value, field


@pytest.mark.parametrize("name", ["tiny", "demo", "rooms", "small", "distill_rooms"])
def test_options_that_a_file_leaves_to_the_reader_can_be_given_on_the_command_line(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    values = importlib.import_module(f"configs.{name}").get_config()
    values.lock()
    left = dict(TrainConfig.from_dict(values.to_dict()).data.sources[0].options)
    assert "lights" not in left and None not in left.values(), "a run of an earlier version is still the same"
    for source in (values.data.sources, values.validation.sources):
        assert _type_on_the_command_line(source, "rooms.options.lights") is int
    values.update_from_flattened_dict({"data.sources.rooms.options.lights": 2})
    assert dict(TrainConfig.from_dict(values.to_dict()).data.sources[0].options) == {**left, "lights": 2}


def test_options_of_rooms_that_are_evaluated_can_be_given_on_the_command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    for name in ("rooms", "ablations", "methods"):
        values = importlib.import_module(f"configs.eval.{name}").get_config()
        values.lock()
        for lights in (None, 2):
            values.options.lights = lights
            run = read_run(values.to_dict())
            assert isinstance(run, ClipRun)
            reader = open_evaluation_set(run.dataset, None, split="test", image_size=(28, 42), options=run.options)
            assert isinstance(reader, Rooms) and reader.furnishing.lights == (lights or 0), name


def test_ablations_of_another_set_have_no_options_of_rooms(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    get_config = importlib.import_module("configs.eval.ablations").get_config
    run = read_run(get_config("seven_scenes").to_dict())
    assert isinstance(run, ClipRun) and (run.dataset, run.split, run.evaluation.stride) == ("seven_scenes", "all", 1)
    with pytest.raises(InputError, match="no sequences of 7-Scenes"):  # it is the folder that is refused
        open_evaluation_set(run.dataset, tmp_path, split=run.split, image_size=(28, 42), options=run.options)
    with pytest.raises(InputError, match="unknown data set 'room'"):
        get_config("room")


@pytest.mark.parametrize("name", ["rooms", "seven_scenes", "methods", "ablations", "paper"])
def test_every_field_of_an_evaluation_can_be_changed_on_the_command_line(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    values = importlib.import_module(f"configs.eval.{name}").get_config()
    run = read_run(values.to_dict())
    parts = [(run, values), (run.timings, values.timings)]
    parts.append((run.evaluation, values.evaluation) if isinstance(run, ClipRun) else (run.protocol, values.protocol))
    for part, fields in parts:
        assert {field.name for field in dataclasses.fields(part)} == set(fields)


@pytest.mark.parametrize("config", ["rooms", "seven_scenes", "methods", "ablations", "paper"])
def test_every_setting_of_a_method_can_be_given_on_the_command_line(
    config: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    values = importlib.import_module(f"configs.eval.{config}").get_config()
    for name, method in METHODS.items():
        fields = {field.name for field in dataclasses.fields(method.settings)}
        assert fields == set(values.settings[name.replace("-", "_")]), name
    values.lock()
    values.update_from_flattened_dict(
        {"settings.pruned.cap": 99, "settings.chunks.loops": True, "settings.anchored_window.window": 3}
    )
    run = read_run(values.to_dict())
    assert run.settings_of("pruned") == PrunedSettings(cap=99) and run.settings_of("chunks").loops
    assert run.settings_of("anchored-window") == AnchoredWindowSettings(window=3)
    assert run.settings_of("causal") == CausalSettings(), "what is not given is the default"


def test_frozen_encoder_is_configured_by_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _config("h20", monkeypatch).model.encoder.frozen
    assert not _config("tiny", monkeypatch).model.encoder.frozen
    assert dataclasses.replace(ModelConfig().encoder, frozen=False) != ModelConfig().encoder
