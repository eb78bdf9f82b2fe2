"""What is final is never lost: a run that ended early is taken up where it was and gives the same bytes."""

from __future__ import annotations

import json
import os
import pkgutil
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from recorder import LONGER_EDGE, Recorder, reconstruct_recorded

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.errors import DiskError, InputError, OutputExists
from logvggt_jax.files import atomic_file
from logvggt_jax.interruption import Interrupted
from logvggt_jax.reconstruction import PointFilter, Reconstruction, open_source, reconstruct
from logvggt_jax.reconstruction.saved_source import source_facts
from logvggt_jax.reconstruction.work_folder import WorkFolder, check_leftovers
from logvggt_jax.streaming import ChunkPlan
from logvggt_jax.streaming.chunks import ChunkSession
from logvggt_jax.streaming.state_file import State
from logvggt_jax.streaming.windows import StreamSession

COUNT, THINNED = 12, PointFilter(max_points=3000)


@pytest.fixture(autouse=True)
def saved_after_every_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """With `save_seconds=0`, whatever the share of the time that saving takes."""
    monkeypatch.setattr("logvggt_jax.reconstruction.run._SAVING", 1e9)


@pytest.fixture(autouse=True)
def signals_reach_this_process() -> Iterator[None]:
    """A shell starts what it runs in the background deaf to Ctrl-C."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    for number in before:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """Twelve frames of noise."""
    folder = tmp_path / "walk"
    folder.mkdir()
    pictures = np.random.default_rng(0).integers(0, 256, (COUNT, 28, 42, 3), np.uint8)
    for index, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"{index:03d}.png")
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def run(predictor: Recorder, walk: Path, output: Path, **options: object) -> Reconstruction:
    options = {"point_filter": THINNED, "save_seconds": 0.0, "progress": False, **options}
    return reconstruct_recorded(predictor, walk, output, **options)


def die_at(frame: int) -> Callable[[int], None]:
    def on_push(count: int) -> None:
        if count == frame:
            raise KeyboardInterrupt

    return on_push


def send_at(frame: int, *signals: int) -> Callable[[int], None]:
    def on_push(count: int) -> None:
        if count == frame:
            for number in signals:
                os.kill(os.getpid(), number)

    return on_push


@pytest.fixture
def straight(walk: Path, tmp_path: Path) -> dict[str, bytes]:
    return contents(run(Recorder(), walk, tmp_path / "straight").folder)


def test_a_run_that_died_twice_gives_the_bytes_of_one_that_did_not(
    walk: Path, tmp_path: Path, straight: dict[str, bytes]
) -> None:
    output = tmp_path / "out"
    for frame in (6, 4):
        with pytest.raises(KeyboardInterrupt):
            run(Recorder(die_at(frame)), walk, output)
        assert not output.exists()
    last = Recorder()
    run(last, walk, output)
    assert last.num_pushed == COUNT - 5 - 3
    assert contents(output) == straight
    assert not (tmp_path / "out.partial").exists()


def test_what_a_killed_run_left_half_written_is_in_no_result(
    walk: Path, tmp_path: Path, straight: dict[str, bytes]
) -> None:
    output, work = tmp_path / "out", tmp_path / "out.partial"
    with pytest.raises(KeyboardInterrupt):
        run(Recorder(die_at(8)), walk, output)
    for file in (work / "depth" / "005.npz", work / "images" / "005.jpg", work / "cameras.json"):
        with pytest.raises(SystemExit), atomic_file(file) as temporary:
            raise SystemExit
        temporary.write_bytes(b"half")
    run(Recorder(), walk, output)
    assert contents(output) == straight


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        ("depth/001.npz", Path.unlink),
        ("depth/001.npz", lambda file: file.write_bytes(b"")),
        ("depth/001.npz", lambda file: file.write_bytes(file.read_bytes()[:200] + b"x" + file.read_bytes()[201:])),
        ("images/001.jpg", lambda file: file.write_bytes(file.read_bytes()[:-300])),
    ],
)
def test_a_damaged_frame_of_a_run_that_ended_early_is_told_before_the_weights(
    walk: Path, tmp_path: Path, file: str, damage: Callable[[Path], object]
) -> None:
    output, work = tmp_path / "out", tmp_path / "out.partial"
    with pytest.raises(KeyboardInterrupt):
        run(Recorder(die_at(8)), walk, output)
    request = json.loads((work / ".progress" / "request.json").read_text())
    check_leftovers(output, request, open_source(walk), overwrite=False)
    damage(work / file)
    before = contents(work)
    said = rf"{file}, of a frame that an earlier run has done, is missing or damaged; pass --overwrite to start anew"
    with pytest.raises(InputError, match=said):
        check_leftovers(output, request, open_source(walk), overwrite=False)
    with pytest.raises(InputError, match=said):
        run(Recorder(), walk, output)
    assert contents(work) == before


@pytest.mark.filterwarnings("ignore:.*no field of view")
@pytest.mark.parametrize("method", ["windows", "chunks"])
def test_the_model_goes_on_with_the_same_numbers(
    method: str, small_config: ModelConfig, small_variables: dict, walk: Path, tmp_path: Path, monkeypatch
) -> None:
    def reconstructed(output: Path) -> dict[str, bytes]:
        return contents(
            reconstruct(
                walk,
                output,
                model=LogVGGT(small_config),
                variables=small_variables,
                method=method,
                settings=ChunkPlan(4, 2) if method == "chunks" else None,
                longer_edge=LONGER_EDGE,
                point_filter=THINNED,
                num_previews=1,
                progress=False,
                save_seconds=0.0,
            ).folder
        )

    straight = reconstructed(tmp_path / "straight")
    session = {"windows": StreamSession, "chunks": ChunkSession}[method]
    original, pushed = session.push, []

    def push(self, frame: np.ndarray) -> list:
        pushed.append(frame)
        if len(pushed) == 8:
            raise KeyboardInterrupt
        return original(self, frame)

    monkeypatch.setattr(session, "push", push)
    with pytest.raises(KeyboardInterrupt):
        reconstructed(tmp_path / "out")
    assert reconstructed(tmp_path / "out") == straight
    assert len(pushed) == COUNT + 1


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_saves_and_ends(walk: Path, tmp_path: Path, straight: dict[str, bytes], number: int) -> None:
    output = tmp_path / "out"
    with pytest.raises(Interrupted, match=r"4 frames are kept in .*out\.partial") as caught:
        run(Recorder(send_at(5, number)), walk, output, save_seconds=1e9)
    assert caught.value.signal == signal.Signals(number).name
    assert not output.exists()
    last = Recorder()
    run(last, walk, output)
    assert last.num_pushed == COUNT - 5
    assert contents(output) == straight


def test_ctrl_c_leaves_a_valid_result_that_can_be_taken_up(
    walk: Path, tmp_path: Path, straight: dict[str, bytes]
) -> None:
    output = tmp_path / "out"
    result = run(Recorder(send_at(5, signal.SIGINT)), walk, output, save_seconds=1e9)
    assert not result.complete and not Reconstruction.open(output).complete
    assert result.num_frames == 5 and result.num_points > 0
    assert "ended early" in result.summary()
    assert not (tmp_path / "out.partial").exists()
    last = Recorder()
    assert run(last, walk, output).complete
    assert last.num_pushed == COUNT - 5
    assert contents(output) == straight


def test_a_second_ctrl_c_stops_at_once_and_keeps_what_was_saved(walk: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(Recorder(send_at(5, signal.SIGINT, signal.SIGINT)), walk, tmp_path / "out")
    last = Recorder()
    assert run(last, walk, tmp_path / "out").num_frames == COUNT
    assert last.num_pushed == COUNT - 4


def test_ctrl_c_before_the_first_frame_leaves_nothing(walk: Path, tmp_path: Path, monkeypatch) -> None:
    waiting = [signal.SIGINT]

    def interrupted(*_: object) -> None:
        if waiting:
            os.kill(os.getpid(), waiting.pop())

    monkeypatch.setattr("logvggt_jax.reconstruction.run.Run._prepare", interrupted)
    with pytest.raises(Interrupted, match="no frame"):
        run(Recorder(), walk, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["walk"]


def test_another_request_is_refused_and_overwrite_starts_anew(
    walk: Path, tmp_path: Path, straight: dict[str, bytes]
) -> None:
    output = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run(Recorder(die_at(6)), walk, output)
    before = contents(tmp_path / "out.partial")
    with pytest.raises(OutputExists, match=r"unfinished.*differs in point_filter.*--overwrite"):
        run(Recorder(), walk, output, point_filter=PointFilter(max_points=10))
    with pytest.raises(OutputExists, match=r"unfinished.*differs in precision"):
        run(Recorder(), walk, output, variables={"params": {"codes": np.zeros((1, 1), np.int8)}})
    assert contents(tmp_path / "out.partial").keys() == before.keys()
    anew = Recorder()
    run(anew, walk, output, overwrite=True)
    assert anew.num_pushed == COUNT
    assert contents(output) == straight
    with pytest.raises(OutputExists, match="exists"):
        run(Recorder(), walk, output)


def test_frames_that_changed_are_noticed_and_later_ones_may_come(walk: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run(Recorder(die_at(6)), walk, output)
    Image.new("RGB", (42, 28)).save(walk / "012.png")
    Image.new("RGB", (42, 28)).save(walk / "002.png")
    with pytest.raises(InputError, match=r"walk has changed.*--overwrite"):
        run(Recorder(), walk, output)
    assert (tmp_path / "out.partial").is_dir()


def test_a_sequence_may_grow_while_its_run_waits(walk: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(Recorder(die_at(6)), walk, tmp_path / "out")
    Image.new("RGB", (42, 28)).save(walk / "012.png")
    last = Recorder()
    assert run(last, walk, tmp_path / "out").num_frames == COUNT + 1
    assert last.num_pushed == COUNT + 1 - 5


def test_a_source_that_breaks_off_keeps_its_frames(walk: Path, tmp_path: Path) -> None:
    file, output = walk / "007.png", tmp_path / "out"
    whole = file.read_bytes()

    def damage(count: int) -> None:
        if count == 1:
            file.write_bytes(whole[: len(whole) // 2])

    with pytest.warns(UserWarning, match=r"6 frames are kept"), pytest.raises(InputError, match=r"007\.png"):
        run(Recorder(damage), open_source(walk, strict=True), output, workers=1)  # type: ignore[arg-type]
    file.write_bytes(whole)
    assert run(Recorder(), open_source(walk, strict=True), output).num_frames == COUNT  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("failing", "words"),
    [
        ("sources.image_folder.read_picture", r"walk/007\.png: too little memory for a picture of 42 x 28 pixels"),
        ("masking.resize", r"walk: too little memory for a picture of 42 x 28 pixels"),
    ],
)
def test_too_little_memory_is_a_line_and_keeps_the_frames(
    walk: Path, tmp_path: Path, straight: dict[str, bytes], failing: str, words: str
) -> None:
    output, asked = tmp_path / "out", []

    def refuse(*arguments: object, **options: object) -> object:
        asked.append(arguments)
        if len(asked) == 8:
            np.empty((1 << 30, 1 << 30), np.uint8)
        return whole(*arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        name = f"logvggt_jax.reconstruction.{failing}"
        whole = pkgutil.resolve_name(name)
        patch.setattr(name, refuse)
        with (
            pytest.warns(UserWarning, match=r"6 frames are kept.*the same command goes on"),
            pytest.raises(InputError, match=rf"{words} \(Unable to allocate .*smaller pictures"),
        ):
            run(Recorder(), walk, output, workers=1, save_seconds=1e9)
    last = Recorder()
    run(last, walk, output)
    assert last.num_pushed == COUNT - 7
    assert contents(output) == straight


def test_where_memory_does_not_suffice_to_save_what_was_saved_before_is_kept(walk: Path, tmp_path: Path) -> None:
    output, refusing = tmp_path / "out", []
    whole = Recorder.snapshot

    def refuse(*_: object, **__: object) -> None:
        refusing.append(True)
        raise MemoryError

    def snapshot(predictor: Recorder) -> tuple:
        return refuse() if refusing else whole(predictor)

    def on_push(count: int) -> None:
        if count == 5:
            patch.setattr("logvggt_jax.reconstruction.masking.resize", refuse)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Recorder, "snapshot", snapshot)
        patch.setattr("logvggt_jax.reconstruction.frame_pool.FramePool.map", lambda _, *arguments: map(*arguments))
        with (
            pytest.warns(UserWarning, match=r"4 frames are kept.*the same command goes on"),
            pytest.raises(InputError, match=r"walk: too little memory .*\(MemoryError\)"),
        ):
            run(Recorder(on_push), walk, output)
    last = Recorder()
    assert run(last, walk, output).num_frames == COUNT
    assert last.num_pushed == COUNT - 5


def test_one_run_at_a_time(tmp_path: Path) -> None:
    output = tmp_path / "out"
    with WorkFolder(output, {"method": "windows"}, overwrite=False) as work:
        work.save(State({}, {}), [])
        for overwrite in (False, True):
            with (
                pytest.raises(InputError, match=rf"another run is using this folder \(process {os.getpid()} on "),
                WorkFolder(output, {"method": "windows"}, overwrite=overwrite),
            ):
                pass
        assert work.saved() is not None


def test_every_damage_of_a_saved_state_is_noticed(tmp_path: Path) -> None:
    output, request = tmp_path / "out", {"method": "windows"}
    arrays = {"tokens": np.arange(6, dtype=np.float32).reshape(2, 3), "pending": np.zeros((0, 3), np.uint8)}
    with WorkFolder(output, request, overwrite=False) as work:
        work.save(State(arrays, {"names": ["a"]}), [])
    file = work.path / ".progress" / "state.safetensors"
    sound = file.read_bytes()
    with WorkFolder(output, request, overwrite=False) as work:
        saved = work.saved()
        assert saved is not None and saved.facts == {"names": ["a"]}
        np.testing.assert_array_equal(saved.arrays["tokens"], arrays["tokens"])
        for position in range(len(sound)):
            damaged = bytearray(sound)
            damaged[position] ^= 1 << position % 8
            file.write_bytes(damaged)
            try:
                found = work.saved()
            except InputError as error:
                assert "state.safetensors" in str(error) and "--overwrite" in str(error)
            else:
                assert found is not None and found.facts == saved.facts and found.arrays.keys() == arrays.keys()
        file.write_bytes(sound)


def test_a_full_disk_is_named_and_keeps_the_state_before(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with WorkFolder(tmp_path / "out", {}, overwrite=False) as work:
        work.save(State({}, {"num_taken": 1}), [])
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
        try:
            with pytest.raises(DiskError, match=r"state\.safetensors: cannot be written"):
                work.save(State({"tokens": np.zeros(10_000, np.float32)}, {"num_taken": 2}), [])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        saved = work.saved()
    assert saved is not None and saved.facts == {"num_taken": 1}


def test_a_folder_or_file_of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "out.partial").mkdir()
    (tmp_path / "out.partial" / "thesis.tex").write_text("x")
    with (
        pytest.raises(OutputExists, match="was not made by this program"),
        WorkFolder(tmp_path / "out", {}, overwrite=True),
    ):
        pass
    assert (tmp_path / "out.partial" / "thesis.tex").read_text() == "x"
    (tmp_path / "walk.partial").write_text("x")
    with (
        pytest.raises(OutputExists, match=r"walk\.partial is in the way and was not made by this program"),
        WorkFolder(tmp_path / "walk", {}, overwrite=True),
    ):
        pass
    assert (tmp_path / "walk.partial").read_text() == "x"


def test_leftovers_are_known_before_the_weights(walk: Path, tmp_path: Path) -> None:
    output, request, source = tmp_path / "out", {"method": "windows", "weights": "1f"}, open_source(walk)
    known, other = {"method": "windows"}, {"method": "chunks"}
    check_leftovers(output, other, source, overwrite=False)
    with WorkFolder(output, request, overwrite=False) as work:
        work.save(State({}, {"names": [], **source_facts(source, 5, [])}), [])
        with pytest.raises(InputError, match="another run is using this folder"):
            check_leftovers(output, known, source, overwrite=True)
    check_leftovers(output, known, source, overwrite=False)
    check_leftovers(output, other, source, overwrite=True)
    with pytest.raises(OutputExists, match=r"out\.partial holds an unfinished.*differs in method;"):
        check_leftovers(output, other, source, overwrite=False)
    work.path.rename(output)  # as Ctrl-C leaves it
    with pytest.raises(OutputExists, match=r"out holds an unfinished.*differs in method;"):
        check_leftovers(output, other, source, overwrite=False)
    work.path.mkdir()
    (work.path / "thesis.tex").write_text("x")
    with pytest.raises(OutputExists, match="was not made by this program"):
        check_leftovers(output, known, source, overwrite=True)


def test_leftovers_of_another_source_or_other_frames_are_known_before_the_weights(walk: Path, tmp_path: Path) -> None:
    plain = shutil.copytree(walk, tmp_path / "plain")
    output, request, source = tmp_path / "out", {"method": "windows"}, open_source(walk, stride=2)
    with WorkFolder(output, request, overwrite=False) as work:
        work.save(State({}, {"names": [], **source_facts(source, 5, [])}), [])
    others = {
        r"plain \(stride=2\)": open_source(plain, stride=2),
        "walk": open_source(walk),
        r"walk \(stride=2, max_frames=4\)": open_source(walk, stride=2, max_frames=4),
    }
    for name, other in others.items():
        words = rf"out\.partial holds an unfinished.* of \S+/walk \(stride=2\), not of \S+/{name}; give its source"
        with pytest.raises(OutputExists, match=words):
            check_leftovers(output, request, other, overwrite=False)
    # More frames of the same are no other ones.
    check_leftovers(output, request, open_source(walk, stride=2, max_frames=6), overwrite=False)
    work.path.rename(output)  # as Ctrl-C leaves it
    with pytest.raises(OutputExists, match="out holds an unfinished"):
        check_leftovers(output, request, open_source(plain), overwrite=False)


def test_leftovers_that_do_not_name_their_source_are_taken_up_or_refused(walk: Path, tmp_path: Path) -> None:
    output, request, source = tmp_path / "out", {"method": "windows"}, open_source(walk)
    facts = {name: fact for name, fact in source_facts(source, 5, []).items() if name != "frames_of"}
    with WorkFolder(output, request, overwrite=False) as work:
        work.save(State({}, {"names": [], **facts}), [])
    check_leftovers(output, request, source, overwrite=False)
    with pytest.raises(InputError, match=r"walk has changed since .*or are taken otherwise; pass --overwrite"):
        check_leftovers(output, request, open_source(walk, stride=2), overwrite=False)


def test_a_partial_result_that_cannot_be_taken_up_stays_where_it_is(walk: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    run(Recorder(send_at(6, signal.SIGINT)), walk, output)
    before = contents(output)
    Image.new("RGB", (42, 28)).save(walk / "002.png")
    with pytest.raises(InputError, match=r"walk has changed since \S+/out was left.*--overwrite"):
        run(Recorder(), walk, output)
    with pytest.raises(OutputExists, match=r"/out holds an unfinished reconstruction of \S+/walk, not of .*stride=2"):
        run(Recorder(), open_source(walk, stride=2), output)  # type: ignore[arg-type]
    assert contents(output) == before and not (tmp_path / "out.partial").exists()


def test_a_killed_process_can_be_taken_up(walk: Path, tmp_path: Path, straight: dict[str, bytes]) -> None:
    """The lock of a process that is gone binds nobody, and what it had saved is used."""
    output = tmp_path / "out"
    script = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from pathlib import Path; import time\n"
        "from recorder import Recorder, reconstruct_recorded\n"
        "from logvggt_jax.reconstruction import PointFilter\n"
        "from logvggt_jax.reconstruction import run; run._SAVING = 1e9\n"
        "wait = lambda count: count > 7 and (print('waiting', flush=True), time.sleep(60))\n"
        "reconstruct_recorded(Recorder(wait), Path(sys.argv[2]), Path(sys.argv[3]), progress=False, save_seconds=0.0,\n"
        "                     point_filter=PointFilter(max_points=3000))\n"
    )
    arguments = [sys.executable, "-c", script, str(Path(__file__).parent), str(walk), str(output)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"waiting\n"
        with pytest.raises(InputError, match=f"process {process.pid} on"):
            run(Recorder(), walk, output)
        process.kill()
        process.wait()
    started = time.monotonic()
    last = Recorder()
    run(last, walk, output)
    assert last.num_pushed == COUNT - 7 and time.monotonic() - started < 60
    assert contents(output) == straight


def test_a_new_result_whose_place_was_taken_stays_where_it_is(tmp_path: Path) -> None:
    """Somebody has put a file into the earlier result during a run that was too short to save a state."""
    output = tmp_path / "walk"
    output.mkdir()
    (output / "cameras.json").write_text("{}")
    with (
        pytest.raises(
            OutputExists, match=r"notes\.txt in it is not .*; the new result is whole in .*walk\.partial: give"
        ),
        WorkFolder(output, {}, overwrite=True) as work,
    ):
        (work.path / "cameras.json").write_text("new")
        (output / "notes.txt").touch()
        work.commit(complete=True)
    assert (output / "notes.txt").is_file() and (output / "cameras.json").read_text() == "{}"
    assert (tmp_path / "walk.partial" / "cameras.json").read_text() == "new"
