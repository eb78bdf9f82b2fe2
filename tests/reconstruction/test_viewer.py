"""The viewer shows what was reconstructed, to this machine only."""

from __future__ import annotations

import socket
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import visitor
from result_folder import write_result
from room_result import write_room_result

from logvggt_jax.errors import InputError, MissingPackage
from logvggt_jax.reconstruction.points.cloud_file import VERTEX, write_points
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.viewer import access_note, open_viewer
from logvggt_jax.reconstruction.viewer.window import Window


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_page_is_served_to_this_machine_only(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    write_result(tmp_path)
    server = open_viewer(tmp_path, port=18080)
    try:
        assert server.get_host() == "127.0.0.1"
        with urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}/", timeout=10) as page:
            assert page.status == 200
    finally:
        server.stop()


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"port": 70000}, "port must be 1 to 65535, got 70000"),
        ({"port": 0}, "port must be 1 to 65535, got 0"),
        ({"host": "no such host"}, "cannot be served at 'no such host', port 8080"),
        ({"host": "192.0.2.1"}, r"cannot be served at '192\.0\.2\.1', port 8080"),
        ({"host": 70 * "x" + ".org"}, "cannot be served at"),
    ],
)
def test_where_nothing_can_be_served_is_one_line_and_no_wait(
    tmp_path: Path, options: dict[str, Any], complaint: str
) -> None:
    write_result(tmp_path)
    with pytest.raises(InputError, match=complaint):
        open_viewer(tmp_path, **options)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_port_in_use_is_passed_over(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    write_result(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        server = open_viewer(tmp_path, port=port)
        try:
            assert server.get_port() > port
        finally:
            server.stop()


@pytest.fixture
def window(tmp_path: Path) -> Iterator[Window]:
    """A viewer of three frames and ten points each, confidence 1, 2 and 3."""
    viser = pytest.importorskip("viser", reason="extra `viewer` is not installed")
    write_result(tmp_path)
    vertices = np.zeros(30, VERTEX)
    vertices["z"], vertices["frame"] = np.arange(30) % 10 + 1, np.arange(30) // 10
    vertices["confidence"] = 1 + vertices["frame"]
    write_points(tmp_path / "points.ply", 30, [vertices])
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    try:
        yield Window(server, Reconstruction.open(tmp_path))
    finally:
        server.stop()


def soon(condition: Callable[[], bool]) -> bool:
    """Whether something comes true; callbacks run in threads of the server's."""
    end = time.monotonic() + 60
    while not (true := condition()) and time.monotonic() < end:
        time.sleep(0.02)
    return true


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_controls_change_what_is_shown(window: Window) -> None:
    assert len(window.points.points) == 30
    size = window.points.point_size
    window.point_size.value = 2.0
    assert soon(lambda: window.points.point_size == pytest.approx(2 * size))
    window.left_out.value = 50
    assert soon(lambda: len(window.points.points) == 20)
    window.frame.value = 2
    window.alone.value = True
    assert soon(lambda: len(window.points.points) == 10)
    window.frame.value = 0  # none of it is sure enough
    assert soon(lambda: len(window.points.points) == 0)
    window.left_out.value = 0
    window.most.value = 4
    assert soon(lambda: len(window.points.points) == 4)
    window.alone.value = False
    window.most.value = 30
    for colouring, count in (("time", 3), ("confidence", 3), ("depth", 10), ("image", 1)):
        window.colouring.value = colouring
        assert soon(lambda count=count: len(np.unique(window.points.colors, axis=0)) == count)
    window.cameras.value = False
    window.dark.value = False
    window.rate.value = 30
    window.play.value = True
    assert soon(lambda: window.frame.value == 2) and soon(lambda: window.frame.value == 1)
    window.play.value = False
    time.sleep(0.2)  # a thread of its own sets it, and ends


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_browser_shows_the_scene_from_where_the_first_camera_looks(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    result = write_room_result(tmp_path, count=4, size=(84, 112))
    server = open_viewer(result.folder, port=18180)
    try:
        with visitor(f"http://127.0.0.1:{server.get_port()}/", tmp_path / "profile"):
            assert soon(lambda: bool(server.get_clients()))
            client = next(iter(server.get_clients().values()))
            assert soon(lambda: np.linalg.norm(client.camera.look_at) > 0)
            picture = client.get_render(300, 400, timeout=60)[..., :3].astype(int)
            forward = np.subtract(client.camera.look_at, client.camera.position)
    finally:
        server.stop()
    axis = result.extrinsics[0, 2, :3]
    assert forward @ axis / np.linalg.norm(forward) > 0.999
    drawn = np.abs(picture - 18).max(axis=2) > 25
    assert drawn.mean() > 0.1 and picture[drawn].std(axis=0).min() > 10


def test_whoever_opens_the_page_to_others_reads_of_tunnels() -> None:
    assert access_note("127.0.0.1", 8080) == access_note("localhost", 8080) == ""
    assert "ssh -N -L 8081:localhost:8081" in access_note("0.0.0.0", 8081)


def test_a_folder_without_reconstruction_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"cameras\.json does not exist"):
        open_viewer(tmp_path)


def test_without_viser_the_line_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_result(tmp_path)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingPackage, match=r'needs viser \(.*\): pip install "logvggt-jax\[viewer\]".*--save'):
        open_viewer(tmp_path)
