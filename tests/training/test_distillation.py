"""A student learns from a teacher alone: labels in the truth's place, kept on disk, and what is refused."""

import dataclasses
import errno
import functools
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl import logging
from pixel_teacher import PixelTeacher

from logvggt_jax import ModelConfig, files
from logvggt_jax.data import open_dataset
from logvggt_jax.data.errors import BrokenPicture
from logvggt_jax.data.feeding.batches import BatchIterator, training_batches
from logvggt_jax.data.feeding.frame_range import FrameRange
from logvggt_jax.data.feeding.listed_frames import listed_frames
from logvggt_jax.errors import DiskError, InputError
from logvggt_jax.metrics.depth import depth_metrics
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.training import loop
from logvggt_jax.training.config import (
    LossConfig,
    OptimizerConfig,
    SourceConfig,
    TeacherConfig,
    TrainConfig,
    ValidationConfig,
)
from logvggt_jax.training.losses.distillation import distilled_depth_losses
from logvggt_jax.training.parallel.sharding import data_mesh, parameter_layout, put_batch
from logvggt_jax.training.reporting.metrics_log import read_metrics
from logvggt_jax.training.step.optimizer import make_optimizer
from logvggt_jax.training.step.state import initial_state
from logvggt_jax.training.step.train_step import make_loss_terms, make_train_step
from logvggt_jax.training.teaching import labelling as module
from logvggt_jax.training.teaching import run_data, teacher
from logvggt_jax.training.teaching.labelling import taught
from logvggt_jax.training.teaching.run_data import label
from logvggt_jax.training.teaching.taught import TaughtDataset
from logvggt_jax.training.teaching.teacher import PlainVGGT
from logvggt_jax.weights.checkpoints import save_model
from logvggt_jax.weights.folder import write_description
from logvggt_jax.weights.provenance import Provenance

SIZE = (28, 42)
OPTIONS = {"height": 28, "width": 42, "num_frames": 10, "num_rooms": 2}
TEACHER = TeacherConfig("anything", clip_length=4, stride=1)


@pytest.fixture(scope="module")
def rooms() -> Any:
    return open_dataset("rooms", None, "train", **OPTIONS)


def labelled(rooms: Any, cache: Path, teacher: PixelTeacher | None = None, **changes: Any) -> TaughtDataset:
    config = dataclasses.replace(TEACHER, **changes)
    return taught("rooms", rooms, teacher or PixelTeacher(), config, [SIZE], cache)


def test_clips_have_the_teachers_labels_and_never_the_truth(rooms: Any, tmp_path: Path) -> None:
    dataset, name = labelled(rooms, tmp_path), rooms.sequences[0]
    assert [each for each in dataset.sequences if each.startswith(name)] == [f"{name}@{i}" for i in (0, 4, 6)]
    assert dataset.num_frames(f"{name}@6") == 4 and dataset.image_size(f"{name}@6") == SIZE
    assert list(dataset.frame_names(f"{name}@6")) == list(rooms.frame_names(name))[6:]
    frames = dataset.read(f"{name}@6", [3, 1])
    np.testing.assert_array_equal(frames.images, rooms.read(name, [9, 7]).images)
    expected = PixelTeacher().label(rooms.read(name, range(6, 10)).images)
    np.testing.assert_array_equal(frames.depth, expected.depth[[3, 1]])
    np.testing.assert_array_equal(frames.extrinsics, expected.extrinsics[[3, 1]])
    np.testing.assert_array_equal(dataset.confidence(f"{name}@6", [3, 1]), expected.confidence[[3, 1]])
    with training_batches({"rooms": dataset}, clip_length=3, batch_size=2, sizes=[SIZE], seed=0) as batches:
        batch = next(batches)
    assert batch["confidence"].shape == batch["depth"].shape == (2, 3, *SIZE)
    np.testing.assert_allclose(np.log(batch["depth"]) + 1, batch["confidence"], rtol=1e-5)


def test_a_clip_knows_its_frames_in_the_whole_sequence(rooms: Any, tmp_path: Path) -> None:
    last = labelled(FrameRange(rooms, (-7, None), "rooms"), tmp_path, stride=2, clip_length=3)
    found = {name.partition("@")[2]: frames for name, frames in listed_frames({"rooms": last})["rooms"].items()}
    # One that grew has clips of the same names, and others in them.
    assert found == {"0": "3:8", "2": "5:10"}


def test_what_was_labelled_once_is_not_labelled_again_unless_teacher_or_pictures_differ(
    rooms: Any, tmp_path: Path
) -> None:
    first, again, other = PixelTeacher(), PixelTeacher(), PixelTeacher("second")
    dataset = labelled(rooms, tmp_path, first)
    labelled(rooms, tmp_path, again)
    labelled(rooms, tmp_path, other)
    assert (first.calls, again.calls, other.calls) == (6, 0, 6)
    folders = sorted((tmp_path / "teacher").iterdir())
    assert len(folders) == 12 and not list((tmp_path / "teacher").glob("*.partial"))
    (next(iter(dataset._clips.values())).labels / "depth.npy").write_bytes(b"cut short")
    with pytest.raises(InputError, match=r"depth\.npy: cannot be read .*start the run again"):
        dataset.read(dataset.sequences[0], [0])
    mended = PixelTeacher()
    labelled(rooms, tmp_path, mended)
    assert mended.calls == 1


@pytest.mark.parametrize("file", ["depth.npy", "confidence.npy", "extrinsics.npy", "digests.json"])
def test_labels_that_have_changed_on_the_disk_are_made_anew(
    rooms: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture, file: str
) -> None:
    logging.use_python_logging(quiet=True)
    folders = {clip.labels for clip in labelled(rooms, tmp_path)._clips.values()}
    damaged, earlier = sorted(folders)[:2]
    (earlier / "digests.json").unlink()
    path = damaged / file
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    teacher = PixelTeacher()
    labelled(rooms, tmp_path, teacher)
    assert teacher.calls == 1 and path.read_bytes() == whole
    assert damaged.name in caplog.text and "the clip is labelled again" in caplog.text


def test_labels_are_opened_by_one_thread_at_a_time(rooms: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads that read a batch ended a run now and then: numpy parses headers with Python's own parser."""
    dataset, alone, load = labelled(rooms, tmp_path), [], np.load
    monkeypatch.setattr(np, "load", lambda *a, **k: (alone.append(files._NUMPY_READING.locked()), load(*a, **k))[1])
    dataset.read(dataset.sequences[0], [0, 1])
    assert alone == [True] * 4 and not files._NUMPY_READING.locked()


def test_labels_that_cannot_be_written_are_one_line_and_leave_nothing(
    rooms: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(DiskError, match=r"teacher/[0-9a-f]{32}: No space left on device"):
        labelled(rooms, tmp_path)
    assert not list((tmp_path / "teacher").iterdir())


def test_what_killed_runs_left_in_the_cache_goes_unless_another_is_at_work(
    run_config: TrainConfig, rooms: Any, tmp_path: Path
) -> None:
    config = dataclasses.replace(
        run_config,
        loss=dataclasses.replace(run_config.loss, name="distillation"),
        data=dataclasses.replace(run_config.data, cache_dir=str(tmp_path)),
        teacher=TEACHER,
    )
    left = [tmp_path / "teacher" / name for name in ("ab.7-cd.partial", ".ab.7-cd.old")]

    def start() -> list[bool]:
        for folder in left:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "depth.npy").write_bytes(b"half")
        label(config, TEACHER, PixelTeacher(), {"rooms": rooms})
        return [folder.exists() for folder in left]

    hold = (
        "import sys; from pathlib import Path; from logvggt_jax.data.cache_use import cache_in_use\n"
        "with cache_in_use(Path(sys.argv[1]), 'teacher', ()): print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", hold, str(tmp_path)], text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        assert start() == [True, True], "it may be writing them"
        other.kill()
    assert start() == [False, False]
    assert len(list((tmp_path / "teacher").iterdir())) == 6


def test_sequences_shorter_than_a_clip_give_what_they_have(rooms: Any, tmp_path: Path) -> None:
    dataset = labelled(rooms, tmp_path, clip_length=64, stride=3)
    assert [dataset.num_frames(name) for name in dataset.sequences] == [4, 4]


def test_a_clip_that_cannot_be_read_is_a_broken_one_and_named(
    rooms: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, broken = rooms.read, {(rooms.sequences[0], 5)}

    def read(sequence: str, indices: Any) -> Any:
        if any((sequence, int(i)) in broken for i in indices):
            raise BrokenPicture("frame 5 is broken")
        return whole(sequence, indices)

    monkeypatch.setattr(rooms, "read", read)
    logging.use_python_logging(quiet=True)
    dataset, damaged = labelled(rooms, tmp_path), f"{rooms.sequences[0]}@4"
    assert len(dataset.sequences) == 6 and damaged not in dataset.labelled().sequences
    assert f"{damaged}: a broken clip, its pictures cannot be read: frame 5 is broken" in caplog.text
    for ask in (dataset.read, dataset.confidence):
        with pytest.raises(InputError, match=rf"{damaged} has no labels.*: mend them and start the run again"):
            ask(damaged, [3])  # of frame 7, which can be read
    broken |= {(name, i) for name in rooms.sequences for i in range(10)}
    with pytest.raises(InputError, match="rooms: no clip of two frames or more that can be read"):
        labelled(rooms, tmp_path)


def test_a_run_goes_on_whatever_pictures_were_mended_or_damaged(tmp_path: Path) -> None:
    generator, pictures = np.random.default_rng(0), [tmp_path / "walk" / f"{i:02}.png" for i in range(12)]
    pictures[0].parent.mkdir()
    for path in pictures:
        cv2.imwrite(str(path), generator.integers(0, 256, (*SIZE, 3), np.uint8))

    def start(damaged: int) -> BatchIterator:
        whole = pictures[damaged].read_bytes()
        pictures[damaged].write_bytes(whole[:100])
        images = open_dataset("images", tmp_path / "walk", "all")
        dataset = taught("images", images, PixelTeacher(), TEACHER, [SIZE, SIZE[::-1]], tmp_path / "cache")
        pictures[damaged].write_bytes(whole)
        assert len(dataset.sequences) == 3
        sizes = [SIZE, SIZE[::-1]]
        return training_batches({"images": dataset}, clip_length=3, batch_size=2, sizes=sizes, seed=0, max_broken=0.5)

    with start(damaged=5) as first, start(damaged=9) as again:
        for _ in range(3):
            next(first)
        again.set_state(first.get_state())
        assert first.broken.count and all("walk@4 has no labels" in message for message in first.broken.messages)
        next(again)


def test_every_process_reads_its_share_and_all_know_what_one_cannot_read(
    rooms: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two processes one after the other: what they tell is noted first, and then handed to both."""
    whole, told, read = rooms.read, {}, []

    def noted(process: int) -> TaughtDataset:
        def flaky(sequence: str, indices: Any) -> Any:
            read.append((process, sequence))
            if process == 1 and (sequence, *indices) == (rooms.sequences[0], 5):
                raise OSError("stale file handle")
            return whole(sequence, indices)

        def from_all(found: np.ndarray) -> np.ndarray:
            told[process] = found
            return np.stack([told[each] for each in sorted(told)])

        monkeypatch.setattr(jax, "process_index", lambda: process)
        monkeypatch.setattr(module, "from_all", from_all)
        monkeypatch.setattr(rooms, "read", flaky)
        return labelled(rooms, tmp_path)

    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(module, "check_agreement", lambda *_: None)
    monkeypatch.setattr(module, "any_process", lambda wants: wants)
    noted(0)
    second, first = noted(1), noted(0)
    assert first._clips == second._clips and len(first.sequences) == 6
    assert [name for name in first.sequences if name not in first.labelled().sequences] == [f"{rooms.sequences[0]}@4"]
    assert sum(process == 1 for process, _ in read) == 4 + 4 + 2


def test_a_process_that_cannot_label_says_so_before_the_others_are_done(
    rooms: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    logging.use_python_logging(quiet=True)
    said: list[str] = []

    def any_process(wants: bool) -> bool:  # waits for the others
        said.append(caplog.text)
        return wants

    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(module, "check_agreement", lambda *_: None)
    monkeypatch.setattr(module, "any_process", any_process)
    (tmp_path / "teacher").write_text("in the way")
    with pytest.raises(DiskError):
        labelled(rooms, tmp_path)
    assert re.search(r"rooms: .*teacher.*: .*; this process waits until the others", said[0])


def test_a_teacher_of_another_kind_is_refused(
    small_config: ModelConfig, run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    provenance = Provenance("windows", 42).to_dict()
    (tmp_path / "model").mkdir()
    description = {"config": small_config.to_dict(), "digests": {}, "provenance": provenance}
    write_description(tmp_path / "model", description)
    with pytest.raises(InputError, match=r"model: trained for 'windows', a teacher is plain VGGT"):
        PlainVGGT(TeacherConfig(str(tmp_path / "model"), 4))
    # Before hours of listing or drawing.
    monkeypatch.setattr(run_data, "open_sources", lambda *_: pytest.fail("data were opened"))
    for name, told in (("model", "trained for 'windows'"), ("none", "no such file or folder")):
        config = dataclasses.replace(
            run_config,
            loss=dataclasses.replace(run_config.loss, name="distillation"),
            data=dataclasses.replace(run_config.data, cache_dir=str(tmp_path)),
            teacher=TeacherConfig(str(tmp_path / name), 4),
        )
        with pytest.raises(InputError, match=told):
            run_data.open_data(config)


def test_a_teachers_weights_are_read_to_label_and_not_where_all_is_labelled(
    small_config: ModelConfig,
    small_variables: dict[str, Any],
    rooms: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    weights, earlier = tmp_path / "teacher", tmp_path / "earlier"
    save_model(weights, small_config, small_variables["params"], Provenance("vggt", 42))
    description = json.loads((weights / "config.json").read_text())
    del description["digest"]
    earlier.mkdir()
    write_description(earlier, {**description, "digests": dict.fromkeys(description["digests"], "of another form")})
    (earlier / "params").mkdir()
    read: list[Path] = []

    def from_pretrained(path: Path) -> tuple[LogVGGT, dict[str, Any]]:
        read.append(path)
        return LogVGGT(small_config), small_variables

    monkeypatch.setattr(teacher, "from_pretrained", from_pretrained)
    lazy, eager = (PlainVGGT(TeacherConfig(str(folder), 4)) for folder in (weights, earlier))
    assert lazy.digest == eager.digest and read == [earlier]
    # Labels of another in its name: to predict takes seconds.
    labelled(rooms, tmp_path, PixelTeacher(lazy.digest))
    labelled(rooms, tmp_path, lazy)
    assert read == [earlier]
    lazy.load()
    assert read == [earlier, weights]
    replaced = PlainVGGT(TeacherConfig(str(weights), 4))
    write_description(weights, {**description, "digests": dict.fromkeys(description["digests"], "xxh3-128:of others")})
    with pytest.raises(InputError, match="other weights lie there than when this run began"):
        replaced.load()


def test_objective_and_teacher_belong_together(run_config: TrainConfig, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="belong together"):
        dataclasses.replace(run_config, teacher=TEACHER)
    loss = dataclasses.replace(run_config.loss, name="distillation")
    with pytest.raises(InputError, match="belong together"):
        dataclasses.replace(run_config, loss=loss)
    nowhere = dataclasses.replace(run_config.data, cache_dir=None)
    with pytest.raises(InputError, match=r"give data\.cache_dir a folder"):
        dataclasses.replace(run_config, loss=loss, data=nowhere, teacher=TEACHER)
    data = dataclasses.replace(run_config.data, cache_dir=str(tmp_path))
    with pytest.raises(InputError, match=r"stages second: clips are longer than the teacher's"):
        dataclasses.replace(run_config, loss=loss, data=data, teacher=dataclasses.replace(TEACHER, clip_length=2))
    larger = dataclasses.replace(run_config.stages[1], sizes=((28, 42), (42, 56)))
    with pytest.raises(InputError, match=r"stages second: sizes differ from those of first; .*the same sizes"):
        stages = (run_config.stages[0], larger)
        dataclasses.replace(run_config, loss=loss, data=data, teacher=TEACHER, stages=stages)
    kept = dataclasses.replace(run_config, loss=loss, data=data, teacher=TEACHER)
    assert TrainConfig.from_dict(kept.to_dict()) == kept


@pytest.mark.parametrize("moment", ["weights", "labels"])
def test_a_teacher_that_does_not_fit_the_device_is_one_line(
    moment: str,
    small_config: ModelConfig,
    small_variables: dict[str, Any],
    run_config: TrainConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise jax.errors.JaxRuntimeError(
            "RESOURCE_EXHAUSTED: Out of memory while trying to allocate 5 bytes.\nBuffers:"
        )

    weights = str(tmp_path / "teacher")
    save_model(Path(weights), small_config, small_variables["params"], Provenance("vggt", 42))
    config = dataclasses.replace(
        run_config,
        loss=dataclasses.replace(run_config.loss, name="distillation"),
        data=dataclasses.replace(run_config.data, cache_dir=str(tmp_path / "cache")),
        teacher=TeacherConfig(weights, clip_length=4),
    )
    if moment == "weights":
        opened = loop.open_data

        def opening(config: TrainConfig) -> Any:  # not before, where shapes are traced
            monkeypatch.setattr(jax, "device_put", full)
            return opened(config)

        monkeypatch.setattr(loop, "open_data", opening)
        said = rf"teacher\.weights={weights} did not fit the memory of cpu: give a smaller teacher"
    else:
        monkeypatch.setattr("logvggt_jax.streaming.offline.predict_plain", full)
        said = (
            rf"teacher\.weights={weights}: full attention over 4 frames of 28 x 42 pixels did not fit .*clip_length=4"
        )
    with pytest.raises(InputError, match=said) as raised:
        loop.train(config, tmp_path / "run", mesh=data_mesh(1))
    assert "trying to allocate 5 bytes" in str(raised.value) and "\n" not in str(raised.value)
    assert not list((tmp_path / "cache").glob("teacher/*")), "no clip of it is taken for labelled"
    assert not list((tmp_path / "run").glob("checkpoints/*"))


def test_errors_count_relative_to_the_teachers_confidence() -> None:
    target, valid = np.ones((2, 1, 2, 2), np.float32), np.ones((2, 1, 2, 2), bool)
    depth = target.copy()
    depth[0, 0, 0, 0] = depth[1, 0, 0, 0] = 3.0
    # Both clips are as sure of the wrong pixel in proportion to the others: 3 times the mean of the rest.
    trust = np.where(np.arange(4).reshape(1, 1, 2, 2) == 0, 3.0, 1.0) * np.array([1.0, 7.0]).reshape(2, 1, 1, 1)
    losses = jax.jit(functools.partial(distilled_depth_losses, alpha=0.2))
    found = losses(depth, trust, target, valid, trust)
    assert float(found["depth_error"].sum().numerator) == pytest.approx(2 * 2.0 * 3 / 1.5)
    assert float(found["depth_confidence"].sum().numerator) == 0.0
    found = losses(depth, np.e * trust, target, valid, trust)
    assert float(found["depth_confidence"].value()) == pytest.approx(0.2)
    nothing = losses(depth, trust, target, np.zeros_like(valid), 0 * trust)
    assert all(float(mean.value()) == 0.0 for mean in nothing.values())


def test_a_student_that_never_saw_the_truth_comes_nearer_to_its_teacher(
    pixel_model: Any,
    pixel_params: Any,
    loss_config: LossConfig,
    optimizer_config: OptimizerConfig,
    run_config: TrainConfig,
    rooms: Any,
    tmp_path: Path,
) -> None:
    """The whole way from pictures to updates, with a model that compiles at once; on rooms it was not taught on."""
    loss = dataclasses.replace(loss_config, name="distillation")
    data = dataclasses.replace(run_config.data, cache_dir=str(tmp_path))
    validation = ValidationConfig(
        (SourceConfig("rooms", None, "val", options=tuple(sorted(OPTIONS.items()))),), 1, 2, 4, 1, SIZE
    )
    config = dataclasses.replace(run_config, loss=loss, data=data, teacher=TEACHER, validation=validation)
    datasets, (held_out,) = label(config, TEACHER, PixelTeacher(), {"rooms": rooms})

    predict = jax.jit(lambda params, images: pixel_model.apply({"params": params}, images).depth)

    def distance(params: Any) -> float:
        errors = []
        for name in held_out.sequences:
            clip = held_out.read(name, range(4))
            depth = np.asarray(predict(params, clip.images[None]))[0]
            errors.append(depth_metrics(depth, clip.depth, alignment="median")["abs_rel"])
        return float(np.mean(errors))

    layout = parameter_layout(pixel_params, data_mesh(1), shard=False)
    optimizer = make_optimizer(optimizer_config, pixel_params, frozen=())
    step = make_train_step(make_loss_terms(pixel_model, loss), loss, optimizer, lambda _: jnp.float32(0.03), layout)
    state = jax.device_put(
        initial_state(jax.tree.map(jnp.array, pixel_params), optimizer),
        layout.shardings(initial_state(pixel_params, optimizer)),
    )
    with training_batches(datasets, clip_length=3, batch_size=4, sizes=[SIZE], seed=0) as batches:
        for _ in range(30):
            state, metrics, _ = step(state, put_batch(next(batches), layout.mesh))
    assert np.isfinite(float(metrics["loss/total"]))
    assert distance(jax.device_get(state.params)) < 0.5 * distance(pixel_params)


def test_a_run_does_not_go_on_with_another_teacher(
    pixel_model: Any, pixel_params: Any, run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "LogVGGT", lambda _: pixel_model)
    monkeypatch.setattr(loop, "initial_parameters", lambda *_, **__: jax.tree.map(jnp.array, pixel_params))
    monkeypatch.setattr(loop, "abstract_parameters", lambda _: jax.eval_shape(lambda: pixel_params))
    # The file's name stands for what is in it.
    monkeypatch.setattr(run_data, "PlainVGGT", lambda config: PixelTeacher(Path(config.weights).name))

    def train(steps: int, weights: str, **changes: Any) -> int:
        config = dataclasses.replace(
            run_config,
            loss=dataclasses.replace(run_config.loss, name="distillation"),
            data=dataclasses.replace(run_config.data, cache_dir=str(tmp_path / "cache")),
            stages=(dataclasses.replace(run_config.stages[0], steps=steps),),
            teacher=TeacherConfig(weights, **{"clip_length": 4, **changes}),
        )
        return int(loop.train(config, tmp_path / "run", mesh=data_mesh(1)).step)

    train(1, "here/first")
    with pytest.raises(InputError, match=r"labels of another teacher \(digests: rooms first, now second\): set "):
        train(2, "here/second")
    with pytest.raises(InputError, match=r"other settings: teacher\.clip_length=4, now 5; teacher\.stride=1, now 2\."):
        train(2, "here/first", clip_length=5, stride=2)
    assert train(2, "moved/first", validation=False) == 2


def test_states_of_before_teachers_were_listed_are_taken(rooms: Any, tmp_path: Path) -> None:
    def start(dataset: Any) -> BatchIterator:
        return training_batches({"rooms": dataset}, clip_length=3, batch_size=2, sizes=[SIZE], seed=0)

    taught_rooms = labelled(rooms, tmp_path)
    with start(rooms) as untaught, start(taught_rooms) as now, start(taught_rooms) as again:
        assert "teachers" not in untaught.get_state()
        before = now.get_state()
        assert before.pop("teachers") == {"rooms": "first"}
        again.set_state(before)
        # Of a stage that is done, to which others are added.
        with pytest.raises(InputError, match="labels of another teacher"):
            again.check_sources({"teachers": {"rooms": "second"}})


@pytest.mark.slow
def test_a_real_student_comes_nearer_to_a_real_teacher(
    small_config: ModelConfig, small_variables: dict[str, Any], run_config: TrainConfig, tmp_path: Path
) -> None:
    """`train` with LoG-VGGT as the student of plain VGGT, both small, on rooms of which it sees pictures alone."""
    # Random weights soon come to a field of view of zero, an infinite focal length: they begin and stay near one.
    head = dataclasses.replace(small_config.camera_head, initial_pose=(0.0,) * 6 + (1.0, 1.0, 1.0))
    encoder = dataclasses.replace(small_config.encoder, frozen=False)
    thawed = dataclasses.replace(small_config, encoder=encoder, camera_head=head)
    params = small_variables["params"]
    near = jax.tree.map(lambda x: 0.2 * x, params["camera_head"]["pose_branch"])
    params = {**params, "camera_head": {**params["camera_head"], "pose_branch": near}}
    save_model(tmp_path / "teacher", thawed, params, Provenance("vggt", 42))
    rooms = tuple(sorted({**OPTIONS, "num_rooms": 16}.items()))
    data = dataclasses.replace(
        run_config.data, sources=(SourceConfig("rooms", None, "train", options=rooms),), cache_dir=str(tmp_path)
    )
    stage = dataclasses.replace(run_config.stages[0], steps=150, clip_length=4, max_stride=1, batch_size=8)
    config = dataclasses.replace(
        run_config,
        model=thawed,
        loss=dataclasses.replace(run_config.loss, name="distillation"),
        optimizer=dataclasses.replace(run_config.optimizer, learning_rate=3e-3),
        stages=(stage,),
        data=data,
        validation=ValidationConfig((SourceConfig("rooms", None, "val", options=rooms),), 150, 8, 4, 1, SIZE),
        teacher=TeacherConfig(str(tmp_path / "teacher"), clip_length=4),
        log_every=50,
        save_every=150,
    )
    loop.train(config, tmp_path / "run", mesh=data_mesh(1))
    entries = read_metrics(tmp_path / "run" / "metrics.jsonl")
    # Not the relative error: the depth of random weights comes near zero.
    for name in ("loss/depth_error", "validation/rotation"):
        first, *_, last = (entry[name] for entry in entries if name in entry)
        assert last < 0.5 * first, name
