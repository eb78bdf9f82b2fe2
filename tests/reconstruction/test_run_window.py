"""A run is shown while it goes on; it waits for no browser, and no error of the viewer's reaches it."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from browser import visitor
from PIL import Image
from recorder import Recorder, reconstruct_recorded
from result_folder import write_result
from room_result import room_frames
from test_growing_scene import encoding, frame

from logvggt_jax.geometry import encode_poses
from logvggt_jax.reconstruction import Reconstruction
from logvggt_jax.reconstruction.viewer import RunWindow, run_window, stop_server, watch_run
from logvggt_jax.reconstruction.watching import LiveResult
from logvggt_jax.streaming import Cameras, FrameResult

PICTURES = np.random.default_rng(0).integers(0, 256, (7, 28, 42, 3), np.uint8)

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


class Onlooker:
    """Keeps what it is shown."""

    def __init__(self) -> None:
        self.frames: list[LiveResult] = []
        self.placed: list[int] = []

    def add(self, frame: LiveResult) -> None:
        self.frames.append(frame)

    def place(self, pose_encodings: np.ndarray) -> None:
        self.placed.append(len(pose_encodings))


@pytest.fixture(autouse=True)
def signals_reach_what_is_started() -> Iterator[None]:
    """A shell starts what it runs in the background deaf to Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """Seven frames of noise."""
    (tmp_path / "walk").mkdir()
    for index, picture in enumerate(PICTURES):
        Image.fromarray(picture).save(tmp_path / "walk" / f"{index}.png")
    return tmp_path / "walk"


def test_who_watches_a_run_sees_every_frame_and_changes_nothing(walk: Path, tmp_path: Path) -> None:
    onlooker = Onlooker()
    options = {"progress": False, "workers": 1}
    watched = reconstruct_recorded(Recorder(), walk, tmp_path / "watched", watcher=onlooker, **options)
    alone = reconstruct_recorded(Recorder(), walk, tmp_path / "alone", **options)
    assert [each.name for each in onlooker.frames] == [str(index) for index in range(7)]
    for each, picture in zip(onlooker.frames, PICTURES, strict=True):
        np.testing.assert_array_equal(each.image, picture)
        np.testing.assert_allclose(each.result.depth, watched.depth(each.result.index), rtol=1e-3)
    assert onlooker.placed[0] == 2  # with the first frames whose pose is not final
    for file in ("cameras.json", "points.ply", "depth/6.npz"):
        assert (watched.folder / file).read_bytes() == (alone.folder / file).read_bytes()


def test_poses_that_cannot_be_shown_do_not_end_the_run(walk: Path, tmp_path: Path) -> None:
    class Full(Recorder):
        def cameras(self, *, provisional: bool = False) -> Cameras:
            if provisional:
                raise MemoryError("the device is full")
            return super().cameras()

    onlooker = Onlooker()
    with pytest.warns(match="poses are shown at the end alone, the run goes on: the device is full"):
        result = reconstruct_recorded(Full(), walk, tmp_path / "out", watcher=onlooker, progress=False)
    assert result.complete and len(onlooker.frames) == 7 and not onlooker.placed


def soon(condition: Callable[[], Any]) -> bool:
    """Whether something comes true."""
    end = time.monotonic() + 60
    while not (true := bool(condition())) and time.monotonic() < end:
        time.sleep(0.02)
    return true


class Visitor:
    """A browser as viser tells of it."""

    client_id = 7

    def __init__(self) -> None:
        self.camera = SimpleNamespace(position=np.zeros(3), look_at=np.zeros(3))

    def atomic(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()


@pytest.fixture
def window(monkeypatch: pytest.MonkeyPatch) -> Iterator[RunWindow]:
    """Of a run that is about to begin, and that draws often."""
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    monkeypatch.setattr(run_window, "_PAUSE", 0.01)
    made = watch_run(port=18280)
    yield made
    stop_server(made.server)


def test_the_page_follows_the_camera_until_its_user_turns_it(
    window: RunWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = Visitor()
    monkeypatch.setattr(window.server, "get_clients", lambda: {7: client})
    window._follow(client)
    for index in range(5):
        window.add(frame(index, encoding(index)))
        ahead = 2.0 * index - 1
        assert soon(lambda ahead=ahead: np.asarray(client.camera.position)[0] > ahead)
    client.camera.position = away = np.array([100.0, 0, 0])
    window.add(frame(5, encoding(5)))
    assert soon(lambda: window._drawn is not None and window._drawn.num_frames == 6)
    time.sleep(0.05)
    assert client.camera.position is away
    window._look_from_start(client)
    assert np.linalg.norm(client.camera.position) < 2
    window._follow(client)
    assert soon(lambda: np.asarray(client.camera.position)[0] > 9)


def test_a_run_that_nobody_looks_at_draws_nothing_and_does_not_wait(
    window: RunWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_window, "draw_points", lambda *_: pytest.fail("it drew"))
    for index in range(50):
        window.add(frame(index, encoding(index)))
    window.show_result(None)
    time.sleep(0.05)
    assert window._drawn is None and window._thread.is_alive()


def test_an_error_of_the_viewer_is_a_warning_and_the_run_goes_on(
    window: RunWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: LiveResult) -> None:
        raise ValueError("no such colour")

    monkeypatch.setattr(window._scene, "add", broken)
    with pytest.warns(match="the viewer shows nothing new, the run goes on: no such colour"):
        window.add(frame(0, encoding(0)))
    window.add(frame(1, encoding(1)))
    window.place(np.stack([encoding(0)]))


def test_at_the_end_the_page_has_the_controls_of_the_result(window: RunWindow, tmp_path: Path) -> None:
    write_result(tmp_path)
    window.add(frame(0, encoding(0)))
    window.show_result(Reconstruction.open(tmp_path))
    assert not window._thread.is_alive()
    labels = {getattr(handle, "label", None) for handle in window.server.gui._gui_input_handle_from_uuid.values()}
    assert {"colour", "frame", "dark ground"} <= labels and "point size" not in labels
    result = Reconstruction.open(tmp_path)
    (tmp_path / "points.ply").write_bytes(b"ply")
    with pytest.warns(match=r"shows nothing new, the run goes on: .*points\.ply is cut off"):
        window.show_result(result)


@pytest.mark.slow
def test_a_browser_shows_a_run_while_it_goes_on(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    frames = room_frames((84, 112), 6)
    encodings = encode_poses(frames.extrinsics, frames.intrinsics, (84, 112)).astype(np.float32)
    window = watch_run(port=18290)
    try:
        with visitor(f"http://127.0.0.1:{window.server.get_port()}/", tmp_path / "profile"):
            assert soon(window.server.get_clients)
            client = next(iter(window.server.get_clients().values()))
            for index, image in enumerate(frames.images):
                sure = np.full((84, 112), 2.0, np.float32)
                result = FrameResult(index, frames.depth[index], sure, encodings[index], True, None, None)
                window.add(LiveResult(f"{index}", index / 8, image, (84, 112), result))
            axis = frames.extrinsics[-1, 2, :3]

            def along() -> float:
                forward = np.subtract(client.camera.look_at, client.camera.position)
                return forward @ axis / max(np.linalg.norm(forward), 1e-9)

            # The thread may have begun to draw before all were there.
            assert soon(lambda: window._drawn is not None and window._drawn.num_frames == 6)
            assert soon(lambda: along() > 0.95)
            time.sleep(0.5)
            assert soon(lambda: along() > 0.95), "a slow browser tells of the way there, too, and then stays"
            picture = client.get_render(300, 400, timeout=60)[..., :3].astype(int)
    finally:
        stop_server(window.server)
    drawn = np.abs(picture - 18).max(axis=2) > 25
    assert drawn.mean() > 0.3 and picture[drawn].std(axis=0).min() > 10


@pytest.mark.slow
def test_the_command_ends_its_run_without_a_browser_and_stays_until_ctrl_c(walk: Path, tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    command = ["reconstruct", str(walk), "--checkpoint", "rooms", "--longer-edge", "42", "--port", "18300", "--view"]
    with subprocess.Popen(
        [sys.executable, "-m", "logvggt_jax", *command, "--output", str(tmp_path / "out")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            lines: list[str] = []
            reader = threading.Thread(target=lambda: lines.extend(process.stderr or ()))
            reader.start()
            assert soon(lambda: any("viewer stays open; Ctrl-C ends it" in line for line in lines)), lines
            assert Reconstruction.open(tmp_path / "out").complete
            address = next(word for line in lines for word in line.split() if word.startswith("http://127.0.0.1"))
            with urllib.request.urlopen(address, timeout=10) as page:
                assert page.status == 200
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0
            reader.join(10)
            assert process.stdout is not None and process.stdout.read().startswith("7 frames in")
        finally:
            process.kill()
