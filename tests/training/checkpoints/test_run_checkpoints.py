"""A run's checkpoints: damage is noticed and passed over, saves are whole or not there, nobody's files are lost."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from logvggt_jax.config import from_mapping
from logvggt_jax.errors import DiskError, InputError, OutputExists
from logvggt_jax.files import FolderLock
from logvggt_jax.training.checkpoints import checkpoint_files, run_checkpoints
from logvggt_jax.training.checkpoints import run_models as module
from logvggt_jax.training.checkpoints.checkpoint_files import DamagedCheckpoint, Position
from logvggt_jax.training.checkpoints.run_checkpoints import RunCheckpoints
from logvggt_jax.training.checkpoints.run_models import RunModels
from logvggt_jax.training.checkpoints.work_folder import PREFLIGHT
from logvggt_jax.training.config import OptimizerConfig, TeacherConfig, TrainConfig
from logvggt_jax.training.step.optimizer import make_optimizer
from logvggt_jax.training.step.state import TrainState, initial_state
from logvggt_jax.weights import Provenance, save_model
from logvggt_jax.weights.folder import write_description

POSITION = Position(1, {"next_index": 12, "sampler": {"seed": 5, "epoch": 2}})


@pytest.fixture
def state(optimizer_config: OptimizerConfig) -> TrainState:
    params = {"camera_head": {"kernel": np.ones((3, 4), np.float32)}}
    state = initial_state(params, make_optimizer(optimizer_config, params, frozen=()))
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.device_put(state, here)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The model folder does not matter here, and the parameters are no model's."""
    monkeypatch.setattr(module, "save_model", lambda *_: None)
    monkeypatch.setattr(module, "unstack_layers", lambda tree, *_: tree)


def _at(state: TrainState, step: int) -> TrainState:
    """Another state for each step."""
    return jax.tree.map(lambda x: x + step if x.dtype == np.float32 else x, state)._replace(step=state.step + step)


def _save(folder: Path, config: TrainConfig, *states: TrainState) -> None:
    with RunCheckpoints(folder, config) as checkpoints:
        for state in states:
            checkpoints.save(state, POSITION)
        checkpoints.wait()


@pytest.fixture
def saved(run_config: TrainConfig, state: TrainState, tmp_path: Path, alone: None) -> Path:
    """A run's folder with one checkpoint, of step 0."""
    _save(tmp_path / "run", run_config, state)
    return tmp_path / "run"


def _restore(
    folder: Path, config: TrainConfig, state: TrainState, step: int | None = None
) -> tuple[TrainState, Position]:
    with RunCheckpoints(folder, config) as checkpoints:
        return checkpoints.restore(state, step=step)


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


def test_descriptions_tell_where_a_start_would_go_on(
    run_config: TrainConfig, state: TrainState, tmp_path: Path
) -> None:
    with RunCheckpoints(tmp_path, run_config) as checkpoints:
        assert checkpoints.resumed_step() is None
        with pytest.raises(InputError, match="no checkpoint of step 3; there are none"):
            checkpoints.resumed_step(3)
        for step in (1, 2):
            checkpoints.save(state._replace(step=np.int32(step)), POSITION)
            checkpoints.wait()
        assert checkpoints.resumed_step() == 2 and checkpoints.resumed_step(1) == 1
        with pytest.raises(InputError, match=r"no checkpoint of step 3; there are \[1, 2\]"):
            checkpoints.resumed_step(3)
        (checkpoints.folder / "2" / "meta" / "metadata").write_text("{")
        assert checkpoints.resumed_step() == 1
        with pytest.raises(DamagedCheckpoint, match=r"step 2 .* cannot be read .*--resume_step \(there are \[1\]\)"):
            checkpoints.resumed_step(2)
        (checkpoints.folder / "1" / "meta" / "metadata").write_text("{")
        with pytest.raises(DamagedCheckpoint, match=r"step 1 .* cannot be read .*; start a new --workdir"):
            checkpoints.resumed_step()


def test_a_checkpoint_from_before_the_digest_is_restored(
    run_config: TrainConfig, state: TrainState, saved: Path
) -> None:
    metadata = saved / "checkpoints" / "0" / "meta" / "metadata"
    _edit(metadata, lambda meta: meta.pop("digest"))
    assert _restore(saved, run_config, state)[1] == POSITION
    _edit(metadata, lambda meta: meta["digests"].pop("params"))
    with pytest.raises(DamagedCheckpoint, match=r"checkpoint of step 0 in .* cannot be read"):
        _restore(saved, run_config, state)


def test_a_checkpoint_with_settings_of_an_earlier_form_is_restored(
    run_config: TrainConfig, state: TrainState, saved: Path
) -> None:
    def as_before(meta: dict[str, Any]) -> None:
        meta.pop("digest")
        meta["config"]["optimizer"].pop("frozen")
        meta["config"]["validation"] = {"source": {"name": "rooms", "root": None, "split": "val"}, "every": 3}

    _edit(saved / "checkpoints" / "0" / "meta" / "metadata", as_before)
    assert _restore(saved, run_config, state)[1] == POSITION
    other = dataclasses.replace(run_config, seed=1)
    with pytest.raises(InputError, match="other settings: seed=0, now 1"):
        _restore(saved, other, state)


def test_the_model_folder_says_how_it_was_trained(
    run_config: TrainConfig, state: TrainState, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Provenance] = []
    monkeypatch.setattr(
        "logvggt_jax.training.checkpoints.run_models.save_model", lambda *saved: written.append(saved[3])
    )
    monkeypatch.setattr("logvggt_jax.training.checkpoints.run_models.unstack_layers", lambda tree, *_: tree)
    with RunCheckpoints(tmp_path / "run", run_config) as checkpoints:
        checkpoints.save(state, POSITION)
    training = from_mapping(Provenance, json.loads(json.dumps(written[0].to_dict())), "provenance").training
    assert training is not None and training.configuration is not None
    assert TrainConfig.from_dict(training.configuration) == run_config
    assert training.steps == 0 and training.device == f"{jax.device_count()} x cpu"
    assert training.data == "rooms (train)"


def test_a_model_has_the_licences_of_what_it_was_made_of(
    run_config: TrainConfig, small_config: Any, tmp_path: Path
) -> None:
    start, teacher, run = (str(tmp_path / name) for name in ("start", "teacher", "run"))
    for folder, terms in ((start, "vggt-1b"), (teacher, "cc-by-nc-4.0")):
        (tmp_path / folder).mkdir()
        provenance = Provenance("vggt", 518, terms).to_dict()
        write_description(
            tmp_path / folder, {"config": small_config.to_dict(), "digests": {}, "provenance": provenance}
        )
    tuned = dataclasses.replace(run_config, initial_weights=start)
    distilled = dataclasses.replace(
        tuned,
        loss=dataclasses.replace(tuned.loss, name="distillation"),
        data=dataclasses.replace(tuned.data, cache_dir=run),
        teacher=TeacherConfig(teacher, clip_length=4),
    )

    def licence(config: TrainConfig) -> str | None:
        with RunCheckpoints(Path(run), config) as checkpoints:
            return checkpoints.models._provenance(0).licence

    assert licence(run_config) is None
    assert licence(tuned) == "vggt-1b"
    assert licence(distilled) == "vggt-1b and cc-by-nc-4.0"
    with RunCheckpoints(Path(run), tuned) as checkpoints:
        provenance = checkpoints.models._provenance(0)
    shutil.rmtree(start)
    assert licence(tuned) is None
    (tmp_path / run / "model").mkdir()
    write_description(
        tmp_path / run / "model", {"config": small_config.to_dict(), "digests": {}, "provenance": provenance.to_dict()}
    )
    assert licence(tuned) == "vggt-1b" and licence(run_config) is None
    moved = shutil.move(tmp_path / run, tmp_path / "elsewhere")
    assert RunModels(Path(moved), tuned)._provenance(0).licence == "vggt-1b"


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


def _damage(checkpoint: Path) -> None:
    largest = max(
        (file for file in (checkpoint / "params").rglob("*") if file.is_file()), key=lambda f: f.stat().st_size
    )
    largest.write_bytes(largest.read_bytes()[: largest.stat().st_size // 2])


def _same(a: Any, b: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(a), jax.device_get(b))


def test_what_lies_on_other_devices_is_fetched_and_not_copied_again(
    run_config: TrainConfig, state: TrainState, tmp_path: Path, alone: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("logvggt_jax.training.checkpoints.run_checkpoints._is_fetched", lambda leaf: True)
    copies = RunCheckpoints._copied(state)
    _same(copies, state)
    shared = [
        np.shares_memory(copy, np.asarray(leaf))
        for copy, leaf in zip(jax.tree.leaves(copies), jax.tree.leaves(state), strict=True)
    ]
    assert all(shared)
    _save(tmp_path / "run", run_config, state)
    _same(_restore(tmp_path / "run", run_config, state)[0], state)


@pytest.mark.usefixtures("abandoned_reads")
@pytest.mark.parametrize("damage", ["values", "description", "nothing left"])
def test_a_damaged_newest_checkpoint_is_named_and_the_one_before_is_taken(
    damage: str, run_config: TrainConfig, state: TrainState, saved: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _save(saved, run_config, _at(state, 3), _at(state, 6))
    newest = saved / "checkpoints" / "6"
    if damage == "values":
        _damage(newest)
    elif damage == "description":
        (newest / "meta" / "metadata").write_text("{")
    else:
        shutil.rmtree(newest)
        newest.mkdir()
    before = sorted(str(file.relative_to(newest)) for file in newest.rglob("*"))
    _same(_restore(saved, run_config, state)[0], _at(state, 3))
    assert "checkpoint of step 6 in" in caplog.text and "going on from the checkpoint before it" in caplog.text
    # It stays for whoever wants to look at it, and is no checkpoint any more.
    aside = saved / "checkpoints" / "6.aside"
    assert sorted(str(file.relative_to(aside)) for file in aside.rglob("*")) == before
    with RunCheckpoints(saved, run_config) as checkpoints:
        assert checkpoints.steps == [3]


@pytest.mark.parametrize("damage", [lambda file: file.write_bytes(b""), Path.unlink])
def test_a_damaged_model_keeps_no_run_from_going_on(
    run_config: TrainConfig,
    state: TrainState,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    damage: Callable[[Path], None],
) -> None:
    monkeypatch.setattr(module, "unstack_layers", lambda tree, *_: tree)
    with RunCheckpoints(tmp_path, run_config) as checkpoints:
        checkpoints.save(_at(state, 3), POSITION)
        checkpoints.save_best(_at(state, 3))
        checkpoints.wait()
    for name in ("model", "best"):
        damage(tmp_path / name / "config.json")
    with RunCheckpoints(tmp_path, run_config) as checkpoints:
        found, _ = checkpoints.restore(state)
        checkpoints.write_missing_model(found)
        checkpoints.wait()
        assert (checkpoints.models.newest_step, checkpoints.models.best_step) == (3, None)
    for name in ("model", "best"):
        assert f"moved to {tmp_path / name}.aside" in caplog.text and (tmp_path / f"{name}.aside").is_dir()
    # What is no model is nobody's to move.
    (tmp_path / "best").mkdir()
    (tmp_path / "best" / "notes.txt").touch()
    with pytest.raises(OutputExists, match="best: exists and is not a model folder"):
        RunCheckpoints(tmp_path, run_config)


@pytest.mark.usefixtures("abandoned_reads")
def test_only_damaged_checkpoints_are_an_error_and_stay(
    run_config: TrainConfig, state: TrainState, saved: Path
) -> None:
    _save(saved, run_config, _at(state, 3))
    for step in ("0", "3"):
        _damage(saved / "checkpoints" / step)
    with pytest.raises(InputError, match=r"checkpoint of step 0 .*start a new --workdir"):
        _restore(saved, run_config, state)
    with pytest.raises(InputError, match=r"checkpoint of step 3 .*--resume_step \(there are \[0\]\)"):
        _restore(saved, run_config, state, step=3)
    with RunCheckpoints(saved, run_config) as checkpoints:
        assert checkpoints.steps == [0, 3]


def test_a_step_is_gone_back_to_once_and_later_checkpoints_are_kept(
    run_config: TrainConfig, state: TrainState, saved: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _save(saved, run_config, _at(state, 3))
    assert int(_restore(saved, run_config, state, step=0)[0].step) == 0
    assert (saved / "checkpoints" / "3.aside" / "params").is_dir()
    _save(saved, run_config, _at(state, 3))
    # The same command is started again, perhaps by a machine.
    _same(_restore(saved, run_config, state, step=0)[0], _at(state, 3))
    assert "--resume_step=0 was honoured before" in caplog.text
    (saved / "checkpoints" / "resumed.json").unlink()
    assert int(_restore(saved, run_config, state, step=0)[0].step) == 0
    assert (saved / "checkpoints" / "3.aside2").is_dir()


def test_a_best_model_of_a_later_step_is_moved_aside_when_the_run_goes_back(
    run_config: TrainConfig, state: TrainState, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _save(saved, run_config, _at(state, 3))

    def keep(folder: Path, config: Any, params: Any, provenance: Provenance) -> None:
        folder.mkdir()
        description = {"config": config.to_dict(), "digests": {}, "provenance": provenance.to_dict()}
        write_description(folder, description)

    monkeypatch.setattr(module, "save_model", keep)
    with RunCheckpoints(saved, run_config) as checkpoints:
        assert checkpoints.models.best_step is None
        checkpoints.save_best(_at(state, 2))
        checkpoints.wait()
        assert checkpoints.models.best_step == 2
    assert _restore(saved, run_config, state)[0].step == 3 and (saved / "best").is_dir()
    _restore(saved, run_config, state, step=0)
    assert (saved / "best.aside").is_dir() and not (saved / "best").exists()


@pytest.mark.parametrize("links", [True, False])
def test_a_best_model_of_the_step_that_is_saved_has_the_files_of_the_newest(
    links: bool, run_config: TrainConfig, state: TrainState, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "unstack_layers", lambda tree, *_: tree)
    saved = tmp_path / "run"
    if not links:
        monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(OSError(errno.EOPNOTSUPP, "no links here")))
    with RunCheckpoints(saved, run_config) as checkpoints:
        checkpoints.save(_at(state, 2), POSITION)
        checkpoints.save_best(_at(state, 2))
        checkpoints.wait()
        names = sorted(path.relative_to(saved / "best") for path in (saved / "best").rglob("*") if path.is_file())
        assert names and all((saved / "best" / name).samefile(saved / "model" / name) == links for name in names)
        before = {name: (saved / "best" / name).read_bytes() for name in names}
        checkpoints.save(_at(state, 3), POSITION)
        checkpoints.wait()
        assert checkpoints.models.best_step == 2 == checkpoints.best_step and checkpoints.models.newest_step == 3
    assert {name: (saved / "best" / name).read_bytes() for name in names} == before


def test_a_best_model_without_room_is_one_line(
    run_config: TrainConfig, state: TrainState, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(47, 0, 47))
    with RunCheckpoints(saved, run_config) as checkpoints:
        checkpoints.save_best(state)
        with pytest.raises(DiskError, match=r"best: needs about 0\.0 MB, .*make room, and the same"):
            checkpoints.wait()


def test_a_save_does_not_keep_the_next_step_waiting_nor_sees_what_it_does(
    run_config: TrainConfig, state: TrainState, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, hashed = threading.Event(), checkpoint_files.digests

    def slow(*given: Any) -> Any:  # the first that a save does with its copies
        assert go_on.wait(60)
        return hashed(*given)

    monkeypatch.setattr(checkpoint_files, "digests", slow)
    expected = jax.device_get(_at(state, 3))
    given = jax.device_put(_at(state, 3), jax.devices()[0])
    with RunCheckpoints(saved, run_config) as checkpoints:
        checkpoints.save(given, POSITION)
        jax.jit(lambda state: jax.tree.map(lambda x: x * 0, state), donate_argnums=0)(given)
        assert checkpoints.steps == [0]
        go_on.set()
        checkpoints.wait()
        assert checkpoints.steps == [0, 3]
        _same(checkpoints.restore(state)[0], expected)


class _Killed(BaseException):
    """Not an error that anything catches."""


# What a save does to the disk, in its order.
MOMENTS = ("write_arrays", "to_disk", "json", "move")


@pytest.mark.parametrize("full", [True, False])
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_save_that_does_not_end_leaves_no_checkpoint(
    moment: str, full: bool, run_config: TrainConfig, state: TrainState, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) if full else _Killed("9")

    with RunCheckpoints(saved, run_config) as checkpoints, monkeypatch.context() as patch:
        if not full:  # Nobody tidies up after a process that was killed.
            patch.setattr(shutil, "rmtree", lambda *_, **__: None)
        if moment == "json":
            patch.setattr(Path, "write_text", fail)
        elif moment == "move":
            patch.setattr("logvggt_jax.files.move_folder", fail)
        else:
            patch.setattr(checkpoint_files, moment, fail)
        checkpoints.save(_at(state, 3), POSITION)
        with pytest.raises(InputError if full else _Killed, match=r"checkpoints/3.*No space left" if full else "9"):
            checkpoints.wait()
        assert checkpoints.steps == [0]
    if full:
        assert [entry.name for entry in (saved / "checkpoints").iterdir()] == ["0"]
    _same(_restore(saved, run_config, state)[0], state)


def test_a_disk_without_room_is_one_line_before_anything_is_written(
    run_config: TrainConfig, state: TrainState, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Parameters, two moments and counters, and the parameters once more in the model folder.
    needed = 4 * 12 * 4 + 5 * 4
    for room in (needed - 1, needed):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, room=room: shutil._ntuple_diskusage(room, 0, room))
        with RunCheckpoints(saved, run_config) as checkpoints:
            checkpoints.save(_at(state, 3), POSITION)
            if room < needed:
                with pytest.raises(DiskError, match=r"checkpoints/3: needs about 0\.0 MB, .*make room, and the same"):
                    checkpoints.wait()
                assert checkpoints.steps == [0] and len(list((saved / "checkpoints").iterdir())) == 1
            else:
                checkpoints.wait()
                assert checkpoints.steps == [0, 3]


def test_a_failed_save_is_told_by_the_next_step(
    run_config: TrainConfig, state: TrainState, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(checkpoint_files, "write_arrays", fail)
    with RunCheckpoints(saved, run_config) as checkpoints:
        checkpoints.check()
        checkpoints.save(_at(state, 3), POSITION)
        checkpoints._writer.submit(lambda: None).result()
        with pytest.raises(InputError, match="No space left"):
            checkpoints.check()


def test_what_killed_saves_left_goes_when_the_run_comes_back(run_config: TrainConfig, saved: Path) -> None:
    left = ["model.7-ab.partial", ".model.7-ab.old", "checkpoints/3.7-ab.partial", "checkpoints/.0.old"]
    for name in left:
        (saved / name / "params").mkdir(parents=True)
    (saved / "model" / "params").mkdir(parents=True)
    write_description(saved / "model", {"config": {}, "digests": {}})
    (saved / "notes").mkdir()
    # Of a preflight that is at work nothing is taken away.
    lock = FolderLock(saved / PREFLIGHT, "wait")
    with RunCheckpoints(saved, run_config):
        assert (saved / PREFLIGHT).is_dir()
    lock.release()
    with RunCheckpoints(saved, run_config) as checkpoints:
        assert checkpoints.steps == [0]
        assert not any((saved / name).exists() for name in (*left, PREFLIGHT))
        assert (saved / "model" / "params").is_dir() and (saved / "notes").is_dir()
    # Killed between two renamings: the old model is the only one.
    (saved / "model").rename(saved / ".model.7-ab.old")
    with RunCheckpoints(saved, run_config):
        assert (saved / "model" / "params").is_dir() and not (saved / ".model.7-ab.old").exists()


def test_a_folder_that_another_run_uses_is_refused(run_config: TrainConfig, saved: Path) -> None:
    hold = (
        "import sys; from pathlib import Path; from logvggt_jax.files import FolderLock\n"
        "lock = FolderLock(Path(sys.argv[1]), 'wait'); print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", hold, str(saved)], text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        (saved / "model.1-a.partial").mkdir()
        for use in (RunCheckpoints.__enter__, RunCheckpoints.check_unused):
            with pytest.raises(InputError, match=rf"another run is using this folder \(process {other.pid} on "):
                use(RunCheckpoints(saved, run_config))
        assert (saved / "model.1-a.partial").is_dir(), "it may be writing that"
        other.kill()
    with RunCheckpoints(saved, run_config):
        assert not (saved / "model.1-a.partial").exists()


def test_the_newest_are_kept_and_one_can_give_its_place(
    run_config: TrainConfig, state: TrainState, saved: Path
) -> None:
    config = dataclasses.replace(run_config, keep_checkpoints=2)
    _save(saved, config, _at(state, 3), _at(state, 6))
    with RunCheckpoints(saved, config) as checkpoints:
        assert checkpoints.steps == [3, 6]
        checkpoints.save(_at(state, 7), POSITION, in_place_of=6)
        checkpoints.wait()
        assert checkpoints.steps == [3, 7]


def test_a_folder_that_process_0_cannot_use_is_an_error_of_the_others_too(
    run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    monkeypatch.setattr(run_checkpoints, "any_process", lambda wants: True)
    with pytest.raises(InputError, match=r"process 0 cannot use .*run; its output says why"):
        RunCheckpoints(tmp_path / "run", run_config).__enter__()
    assert not (tmp_path / "run").exists()
