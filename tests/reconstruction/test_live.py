"""A live session uses the newest frames, counts the others, times every stage, and ends with a valid result."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from recorder import LONGER_EDGE, Recorder

from logvggt_jax import LogVGGT, ModelConfig, StreamSession
from logvggt_jax.cli import main
from logvggt_jax.errors import DiskError, InputError
from logvggt_jax.interruption import Interrupted
from logvggt_jax.reconstruction import Reconstruction, Source, SourceFrame, SourceOptions, frame_writer
from logvggt_jax.reconstruction.calibration import Calibration
from logvggt_jax.reconstruction.exporters.pictures import Pictures, picture_size
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.fusion.rescale import rescale
from logvggt_jax.reconstruction.live import (
    LiveResult,
    LiveSession,
    OnlineSettings,
    Recording,
    capture,
    online_stream,
    recording,
)
from logvggt_jax.reconstruction.live.follow import follow
from logvggt_jax.reconstruction.live.newest import FrameCounts, NewestFrames
from logvggt_jax.reconstruction.sources import masks

PICTURES = np.random.default_rng(0).integers(0, 256, (12, 28, 42, 3), np.uint8)


class FakeCamera(Source):
    """Gives pictures, a connection after the other; before each one it calls `on_frame` with its number in all."""

    def __init__(
        self, *connections: int, on_frame: Callable[[int], object] = lambda _: None, step: float = 0.0
    ) -> None:
        super().__init__(Path("camera"), SourceOptions())
        self.address, self._connections = None, list(connections)
        self._on_frame, self._step, self._given = on_frame, step, 0

    @property
    def expected_frames(self) -> None:
        return None

    @property
    def image_size(self) -> None:
        return None

    def fingerprint(self, count: int) -> str:
        return ""

    def loaders(self, first: int = 0) -> Iterator[Callable[[], SourceFrame | None]]:
        if not self._connections:
            raise InputError("camera cannot be opened: is it connected?")
        for index in range(self._connections.pop(0)):
            self._on_frame(self._given)
            picture, self._given = PICTURES[self._given], self._given + 1
            yield lambda index=index, picture=picture: SourceFrame(f"{index}", index * self._step, picture)


@pytest.fixture(autouse=True)
def signals_reach_this_process() -> Iterator[None]:
    """A shell starts what it runs in the background deaf to Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def session(predictor: Recorder | None = None, **options: Any) -> LiveSession:
    """Of the stand-in, which is not warmed up; nothing is dropped unless the options say so."""
    predictor = predictor or Recorder()
    return LiveSession(lambda: predictor, **{"longer_edge": LONGER_EDGE, "warm_up": 0, "capacity": 12, **options})


def test_of_waiting_frames_the_oldest_goes_and_every_frame_is_counted() -> None:
    queue: NewestFrames[int] = NewestFrames(2)
    for frame in range(5):
        queue.put(frame)
    assert queue.counts == FrameCounts(received=5, taken=0, dropped=3, waiting=2)
    assert queue.take() == 3
    queue.put(5)
    queue.close()
    assert [queue.take(), queue.take(), queue.take()] == [4, 5, None]
    assert queue.counts == FrameCounts(received=6, taken=3, dropped=3, waiting=0)


def test_frames_that_come_while_the_device_works_are_dropped_but_for_the_newest() -> None:
    entered, release, results = threading.Event(), threading.Event(), list[LiveResult]()

    def on_push(_: int) -> None:
        entered.set()
        assert release.wait(10)

    with session(Recorder(on_push), capacity=2, on_result=results.append) as live:
        live.push(PICTURES[0], 0.0)
        assert entered.wait(10)
        for index in range(1, 10):
            live.push(PICTURES[index], index / 30)
        assert (live.report().received, live.report().dropped, live.report().waiting) == (10, 7, 2)
        release.set()
    report = live.report()
    assert (report.received, report.used, report.dropped, report.waiting, report.finished) == (10, 3, 7, 0, 3)
    assert [each.name for each in results] == ["frame-000000", "frame-000008", "frame-000009"]
    assert [each.timestamp for each in results] == [0.0, 8 / 30, 9 / 30]
    assert [each.result.index for each in results] == [0, 1, 2]
    for each, index in zip(results, (0, 8, 9), strict=True):
        np.testing.assert_array_equal(each.image, PICTURES[index])
    with pytest.raises(ValueError, match="has ended"):
        live.push(PICTURES[0])


def test_a_session_whose_first_frame_is_old_when_it_is_warm_begins_with_neighbours() -> None:
    warm, results = threading.Event(), list[LiveResult]()
    predictors = iter((Recorder(lambda _: warm.wait(10)), Recorder()))
    options = {"longer_edge": LONGER_EDGE, "warm_up": 3, "capacity": 2, "on_result": results.append}
    with LiveSession(lambda: next(predictors), **options) as live:
        for picture in PICTURES[:6]:
            live.push(picture)
            while live.report().used == 0:  # the first is on its way
                time.sleep(0.001)
        warm.set()
    assert [each.name for each in results] == ["frame-000004", "frame-000005"]
    assert (live.report().used, live.report().dropped) == (2, 4)


def test_every_stage_is_timed_and_told() -> None:
    def slow(_: object) -> None:
        time.sleep(0.02)

    camera = FakeCamera(6, on_frame=slow)
    live = session(Recorder(slow), on_result=slow)
    follow(camera, live)
    report = live.report()
    assert list(report.latencies) == ["capture", "wait", "resize", "device", "result", "final"]
    assert [times.measured for times in report.latencies.values()] == [6, 6, 6, 3, 3, 6]
    for name, least in {"capture": 0.02, "device": 0.02, "result": 0.04, "final": 0.04}.items():
        assert least <= report.latencies[name].median <= report.latencies[name].most, name
    assert report.fps is not None and report.fps < 50
    assert json.loads(json.dumps(report.as_json()))["latencies"]["device"]["measured"] == 3
    assert "6 in, 6 used, 0 dropped" in report.line()
    assert report.table().startswith("6 frames in: 6 used, 0 dropped; ")
    assert all(f"\n{name} " in report.table() for name in report.latencies)


def test_the_numbers_are_those_of_a_stream_of_the_frames_that_were_used(
    small_config: ModelConfig, small_variables: dict
) -> None:
    model, settings = LogVGGT(small_config), OnlineSettings(context=3, max_registers=16)
    results: list[LiveResult] = []
    options = {"longer_edge": LONGER_EDGE, "capacity": 12, "on_result": results.append}
    with LiveSession(lambda: online_stream(model, small_variables, settings), **options) as live:
        for picture in PICTURES[:9]:
            live.push(picture)
    refinement = dataclasses.replace(small_config.refinement, period=2, context=3, max_registers=16)
    plain = StreamSession(LogVGGT(dataclasses.replace(small_config, refinement=refinement)), small_variables, ahead=0)
    expected = [result for picture in PICTURES[:9] for result in plain.push(picture)] + plain.close()
    assert [each.result.index for each in results] == list(range(9))
    for each, wanted in zip(results, expected, strict=True):
        np.testing.assert_array_equal(each.result.depth, wanted.depth)
        np.testing.assert_array_equal(each.result.pose_encoding, wanted.pose_encoding)
        assert each.result.pose_is_final
    cameras = live.cameras()
    assert cameras is not None
    np.testing.assert_array_equal(cameras.extrinsics, plain.cameras().extrinsics)


def test_what_a_mask_drops_has_no_influence_and_no_depth(small_config: ModelConfig, small_variables: dict) -> None:
    model, mask = LogVGGT(small_config), np.ones((28, 42), bool)
    mask[14:, :14] = False
    found: list[list[LiveResult]] = []
    for number in range(2):
        shown, results = PICTURES.copy(), list[LiveResult]()
        shown[:, ~mask] = 200 * number
        options = {"longer_edge": LONGER_EDGE, "capacity": 12, "on_result": results.append}
        with LiveSession(lambda: online_stream(model, small_variables), **options) as live:
            for picture in shown[:6]:
                live.push(picture, mask=mask)
        found.append(results)
    for first, second in zip(*found, strict=True):
        np.testing.assert_array_equal(first.result.depth, second.result.depth)
        np.testing.assert_array_equal(first.result.depth > 0, mask)
        np.testing.assert_array_equal(first.result.pose_encoding, second.result.pose_encoding)


def test_a_recording_has_the_intrinsics_that_are_known_and_a_camera_the_mask_of_all_its_frames(tmp_path: Path) -> None:
    black = np.zeros((28, 42), np.uint8)
    black[:14] = 255
    Image.fromarray(black).save(tmp_path / "arm.png")

    class Masked(FakeCamera):
        def loaders(self, first: int = 0) -> Iterator[Callable[[], SourceFrame | None]]:
            assert self.masks is not None
            for load in super().loaders(first):
                frame = load()
                assert frame is not None
                mask = self.masks.read(masks.Masked(frame.name, "", (28, 42)))
                yield lambda frame=frame, mask=mask: frame._replace(mask=mask)

    camera, predictor = Masked(5), Recorder()
    camera.masks = masks.Masks(tmp_path / "arm.png")
    calibration = Calibration((50.0, 51.0, 20.0, 14.0))
    follow(camera, live := session(predictor, recording=Recording(tmp_path / "out", calibration=calibration)))
    assert all(mask is not None and (mask == (black > 0)).all() for mask in predictor.masks)
    assert live.reconstruction is not None
    np.testing.assert_allclose(live.reconstruction.intrinsics, [[[50.0, 0, 20], [0, 51, 14], [0, 0, 1]]] * 5)
    outside = Calibration((50.0, 51.0, 420.0, 14.0))
    with pytest.raises(InputError, match=r"principal point 420,14 lies outside of images of 42 x 28 pixels"):
        follow(FakeCamera(5), session(recording=Recording(tmp_path / "none", calibration=outside)))
    assert not (tmp_path / "none").exists()


def test_a_recording_that_keeps_originals_is_exported_at_the_cameras_size(tmp_path: Path) -> None:
    large = np.repeat(np.repeat(PICTURES, 3, axis=1), 3, axis=2)
    with session(recording=Recording(tmp_path / "out", keep_originals=True, num_previews=0)) as live:
        for picture in large[:4]:
            live.push(picture)
    result = live.reconstruction
    assert result is not None and result.image_size == (84, 126) and result.depth_size == (28, 42)
    metric = rescale(result, tmp_path / "metres", frames=("0", "3"), distance=6.0, progress=False)
    for kept_by in (result, metric.result):
        pictures = Pictures.of(kept_by)
        assert pictures.size == picture_size(kept_by) == (84, 126)
        np.testing.assert_array_equal(pictures.intrinsics, result.intrinsics)
        with FramePool() as pool:
            found = list(pictures.read(pool))
        assert len(found) == 4
        assert all(np.abs(a.astype(int) - b).mean() < 6 for a, b in zip(found, large, strict=False))
    (tmp_path / "out" / "originals" / "frame-000002.jpg").unlink()
    with FramePool() as pool, pytest.raises(InputError, match=r"originals/frame-000002\.jpg does not exist"):
        list(Pictures.of(result).read(pool))


def test_of_a_recording_that_an_error_ends_the_originals_of_what_is_kept_stay(tmp_path: Path) -> None:
    def broken(result: LiveResult) -> None:
        if result.result.index == 3:
            raise RuntimeError("the robot fell over")

    live = session(on_result=broken, recording=Recording(tmp_path / "out", keep_originals=True, workers=1))
    with pytest.raises(RuntimeError, match="fell over"), pytest.warns(match=r"4 frames that were final are kept"):
        follow(FakeCamera(8), live)
    kept = sorted((tmp_path / "out" / "originals").iterdir())
    assert [file.name for file in kept] == [f"frame-{index:06d}.jpg" for index in range(4)]


def test_an_unplugged_camera_leaves_what_is_final_and_one_line(tmp_path: Path) -> None:
    live = session(recording=Recording(tmp_path / "out", num_previews=1, workers=1))
    lost = follow(FakeCamera(5), live)
    assert lost == "camera is lost: no more frames come; is it still connected?"
    result = Reconstruction.open(tmp_path / "out")
    assert result.names == tuple(f"frame-{index:06d}" for index in range(5)) and not result.complete
    assert result.num_points > 0 and (result.folder / "trajectory.txt").is_file()
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]


def test_a_camera_that_gives_nothing_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^camera cannot be opened: is it connected\?$"):
        follow(FakeCamera(), session(recording=Recording(tmp_path / "out")))
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_ends_with_a_whole_result(tmp_path: Path) -> None:
    silent = threading.Event()

    def on_frame(number: int) -> None:
        if number == 5:
            os.kill(os.getpid(), signal.SIGINT)
            silent.wait(10)  # as a camera may be, for ever

    live = session(recording=Recording(tmp_path / "out", num_previews=1, workers=1))
    began = time.monotonic()
    assert follow(FakeCamera(9, on_frame=on_frame), live) is None
    assert time.monotonic() - began < 9
    silent.set()
    result = Reconstruction.open(tmp_path / "out")
    assert result.num_frames == 5 and result.complete
    assert live.reconstruction is not None and live.reconstruction.folder == result.folder
    np.testing.assert_allclose(result.extrinsics[:, 0, 3], np.arange(5))


def test_ctrl_c_before_the_first_frame_is_told_as_such() -> None:
    def on_frame(_: int) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.2)

    with pytest.raises(Interrupted, match="no frame had come yet"):
        follow(FakeCamera(1, on_frame=on_frame), session())


def test_a_stream_that_comes_back_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture, "_PAUSE", 0.01)
    results: list[LiveResult] = []
    live = session(on_result=results.append)
    lost = follow(FakeCamera(3, 0, 2, step=0.001), live, reconnect=0.05)
    assert lost == "camera is lost: cannot be opened: is it connected?"
    assert [each.name for each in results] == [f"frame-{index:06d}" for index in range(5)]
    times = [each.timestamp for each in results]
    np.testing.assert_allclose(np.diff(times)[[0, 1, 3]], 0.001)
    assert times[3] - times[2] > 0.01


def test_time_goes_on_from_where_a_fast_clock_was_when_the_stream_was_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture, "_PAUSE", 0.01)
    results: list[LiveResult] = []
    follow(FakeCamera(3, 2, step=10.0), session(on_result=results.append), reconnect=0.05)
    steps = np.diff([each.timestamp for each in results])
    np.testing.assert_allclose(steps[[0, 1, 3]], 10.0)
    assert 0.01 < steps[2] < 5


def test_a_video_is_played_at_its_own_pace_and_its_end_is_no_loss(tmp_path: Path) -> None:
    live = session(recording=Recording(tmp_path / "out", num_previews=1, workers=1))
    began = time.monotonic()
    assert follow(FakeCamera(4, step=0.1), live, realtime=True) is None
    assert time.monotonic() - began >= 0.3
    assert Reconstruction.open(tmp_path / "out").complete


def test_a_video_waits_until_the_programs_are_there() -> None:
    results, opened = list[LiveResult](), iter((Recorder(lambda _: time.sleep(0.05)), Recorder()))
    options = {"longer_edge": LONGER_EDGE, "warm_up": 6, "capacity": 2, "on_result": results.append}
    live = LiveSession(lambda: next(opened), **options)
    assert follow(FakeCamera(6, step=0.02), live, realtime=True) is None
    assert (live.report().used, live.report().dropped) == (6, 0)
    assert [each.name for each in results] == [f"frame-{index:06d}" for index in range(6)]


def kept(folder: Path, count: int) -> Reconstruction:
    """The result in `folder/out`, which is whole, incomplete, of so many frames, and alone there."""
    result = Reconstruction.open(folder / "out")
    assert result.names == tuple(f"frame-{index:06d}" for index in range(count)) and not result.complete
    assert len(list((result.folder / "depth").iterdir())) == len(list((result.folder / "images").iterdir())) == count
    assert result.cloud().frame is not None and set(result.cloud().frame) == set(range(count))
    assert "goes on" not in result.summary()
    assert [entry.name for entry in folder.iterdir()] == ["out"]
    return result


def test_an_error_in_the_session_reaches_the_caller_and_what_was_final_is_kept(tmp_path: Path) -> None:
    def broken(result: LiveResult) -> None:
        if result.result.index == 3:
            raise RuntimeError("the robot fell over")

    live = session(on_result=broken, recording=Recording(tmp_path / "out", num_previews=1, workers=1))
    with (
        pytest.raises(RuntimeError, match="fell over"),
        pytest.warns(match=r"4 frames that were final are kept in .*out"),
    ):
        follow(FakeCamera(8), live)
    assert live.reconstruction is not None and live.reconstruction.folder == kept(tmp_path, 4).folder


def test_an_error_of_the_source_reaches_the_caller_and_every_frame_before_it_is_kept(tmp_path: Path) -> None:
    def broken(number: int) -> None:
        if number == 5:
            raise RuntimeError("the decoder crashed")

    live = session(recording=Recording(tmp_path / "out", num_previews=1, workers=1))
    with pytest.raises(RuntimeError, match="decoder crashed"), pytest.warns(match=r"before is kept in .*out"):
        follow(FakeCamera(8, on_frame=broken), live)
    kept(tmp_path, 5)


def test_of_a_session_that_is_left_by_an_error_what_was_used_is_kept(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), pytest.warns(match="frames that were final are kept"):  # noqa: SIM117
        with session(recording=Recording(tmp_path / "out", num_previews=1, workers=1)) as live:
            for picture in PICTURES[:5]:
                live.push(picture)
            while live.report().used < 5:
                time.sleep(0.001)
            raise KeyboardInterrupt
    kept(tmp_path, 5)


def test_a_full_disk_leaves_what_was_written_with_the_points_that_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reserve, write = tmp_path / "out.partial" / ".progress" / "reserve", frame_writer.write_depth

    def write_depth(path: Path, *arrays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if path.stem == "frame-000005":
            assert reserve.stat().st_size == 16_000_000
            raise DiskError(f"{path}: No space left on device")
        return write(path, *arrays)

    def disk_usage(_: Path) -> Any:
        assert not reserve.exists()
        return shutil._ntuple_diskusage(10**9, 10**9, 2 * 23 * 100)

    monkeypatch.setattr(frame_writer, "write_depth", write_depth)
    monkeypatch.setattr(recording.shutil, "disk_usage", disk_usage)
    with pytest.raises(DiskError, match="No space left"), pytest.warns(match="5 frames that were final are kept"):
        follow(FakeCamera(12), session(recording=Recording(tmp_path / "out", num_previews=1, workers=1)))
    assert 80 <= kept(tmp_path, 5).num_points <= 100


def test_who_is_impatient_while_a_recording_is_finished_keeps_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, finish = [], recording.finish

    def interrupted(*arguments: Any, **options: Any) -> None:
        calls.append(options["num_previews"])
        if len(calls) == 1:
            raise KeyboardInterrupt
        finish(*arguments, **options)

    monkeypatch.setattr(recording, "finish", interrupted)
    with pytest.raises(KeyboardInterrupt), pytest.warns(match="6 frames that were final are kept"):
        follow(FakeCamera(6), session(recording=Recording(tmp_path / "out", num_previews=1, workers=1)))
    kept(tmp_path, 6)
    assert calls == [1, 0]


def test_an_error_before_anything_was_final_leaves_no_folder(tmp_path: Path) -> None:
    def broken(_: int) -> None:
        raise RuntimeError("no device")

    with pytest.raises(RuntimeError, match="no device"):
        follow(FakeCamera(8), session(Recorder(broken), recording=Recording(tmp_path / "out")))
    assert list(tmp_path.iterdir()) == []


def test_frames_of_another_kind_are_refused() -> None:
    with session() as live:
        live.push(PICTURES[0])
        with pytest.raises(InputError, match=r"were 42 x 28 pixels large and now are 28 x 28"):
            live.push(PICTURES[0][:, :28])
        with pytest.raises(InputError, match=r"uint8 \[H, W, 3\], got float32"):
            live.push(PICTURES[0].astype(np.float32))
        with pytest.raises(InputError, match=r"a mask must be bool \[28, 42\], got bool \[28, 28\]"):
            live.push(PICTURES[0], mask=np.ones((28, 28), bool))
        with pytest.raises(InputError, match="masks for all frames or for none"):
            live.push(PICTURES[0], mask=np.ones((28, 42), bool))
    for options, complaint in (({"capacity": 0}, "capacity"), ({"longer_edge": 43}, "14")):
        with pytest.raises(InputError, match=complaint):
            session(**options)
    with pytest.raises(InputError, match="max_registers"):
        OnlineSettings(max_registers=0)


def test_a_video_without_realtime_is_refused_before_a_model_is_looked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "walk").mkdir()
    Image.fromarray(PICTURES[0]).save(tmp_path / "walk" / "0.png")
    assert main(["live", str(tmp_path / "walk"), "--checkpoint", "nowhere"]) == 2
    assert "is no camera: add --realtime" in capsys.readouterr().err
    arguments = ["live", str(tmp_path / "walk"), "--checkpoint", "nowhere", "--realtime"]
    assert main([*arguments, "--reconnect", "1"]) == 2
    assert "walk ends where it ends, and there is nothing to wait for" in capsys.readouterr().err
    assert main([*arguments, "--period", "0"]) == 2
    assert "--period must be at least 1, got 0" in capsys.readouterr().err
    assert main([*arguments, "--queue", "0"]) == 2
    assert "--queue must be at least 1 frame, got 0" in capsys.readouterr().err
    assert main([*arguments, "--keep-originals"]) == 2
    assert "--keep-originals is of a result: give --output, too" in capsys.readouterr().err
    assert main([*arguments, "--shared-intrinsics"]) == 2
    assert "--intrinsics and --shared-intrinsics are of a result: give --output, too" in capsys.readouterr().err
    assert main(["live", "0", "--checkpoint", "nowhere", "--masks", str(tmp_path / "walk")]) == 2
    assert "walk is a folder: a camera or a stream takes one mask" in capsys.readouterr().err


def test_an_address_where_nobody_answers_is_told_before_the_weights_are_read(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("logvggt_jax.weights.checkpoints.from_pretrained", lambda *_, **__: pytest.fail("weights read"))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}/walk"
        assert main(["live", address, "--checkpoint", "rooms"]) == 2
    assert f"{address} cannot be opened" in capsys.readouterr().err
