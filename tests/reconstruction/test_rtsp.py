"""Live sessions follow a real RTSP server until it is stopped, falls silent, or comes back."""

from __future__ import annotations

import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from recorder import LONGER_EDGE, Recorder

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction import Reconstruction, open_source
from logvggt_jax.reconstruction.live import LiveResult, LiveSession, Recording
from logvggt_jax.reconstruction.live.follow import follow
from logvggt_jax.reconstruction.sources import video

pytestmark = pytest.mark.slow

_SERVER = Path(__file__).with_name("rtsp_server.py")
_BINDINGS = "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import GstRtspServer"


class Server:
    """A server that can be stopped, held and started again; its address stays."""

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.address = f"rtsp://127.0.0.1:{self._port}/ball"
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        with _SERVER.open() as script:
            command = ["python3", "-", str(self._port)]
            self._process = subprocess.Popen(command, stdin=script, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n", "the server does not start; it says why on standard error"

    def hold(self) -> None:
        """It answers no more, but its connections stay."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)

    def stop(self) -> None:
        if self._process is not None and self._process.stdout is not None:
            self._process.kill()
            self._process.wait()
            self._process.stdout.close()
            self._process = None


@pytest.fixture
def server() -> Iterator[Server]:
    try:
        there = subprocess.run(["python3", "-c", _BINDINGS], capture_output=True).returncode == 0
    except FileNotFoundError:
        there = False
    if not there:
        pytest.skip("the system's python3 has no GStreamer RTSP server (Debian: gir1.2-gst-rtsp-server-1.0)")
    server = Server()
    server.start()
    yield server
    server.stop()


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "_TIMEOUT", 3.0)


def watch(
    server: Server, after: dict[int, Callable[[], object]], *, folder: Path, reconnect: float | None = None
) -> str:
    """What is said in the end of a server to which things happen after so many frames; the result is in `folder`."""
    count = 0

    def on_result(_: LiveResult) -> None:
        nonlocal count
        count += 1
        after.get(count, lambda: None)()

    session = LiveSession(
        Recorder, longer_edge=LONGER_EDGE, warm_up=0, capacity=2, on_result=on_result, recording=Recording(folder)
    )
    lost = follow(open_source(server.address, most_broken=1.0), session, reconnect=reconnect, progress=False)
    assert lost is not None
    counts = session.report()
    assert counts.received == counts.used + counts.dropped and counts.used >= max(after)
    return lost


@pytest.mark.parametrize("end", [Server.stop, Server.hold], ids=["stopped", "silent"])
def test_a_server_that_is_gone_leaves_what_was_seen(server: Server, tmp_path: Path, end: Callable) -> None:
    began = time.monotonic()
    lost = watch(server, {20: lambda: end(server)}, folder=tmp_path / "out")
    assert lost == f"{server.address} is lost: no more frames come; is it still connected?"
    assert time.monotonic() - began < 25
    result = Reconstruction.open(tmp_path / "out")
    assert result.num_frames >= 20 and not result.complete
    times = result.timestamps
    assert (np.diff(times) > 0).all() and abs(np.median(np.diff(times)) - 1 / 15) < 0.01


def test_a_server_that_comes_back_is_followed_on(server: Server, tmp_path: Path) -> None:
    def restart() -> None:
        server.stop()
        server.start()

    lost = watch(server, {20: restart, 40: server.stop}, folder=tmp_path / "out", reconnect=6)
    assert lost.startswith(f"{server.address} is lost: cannot be opened")
    result = Reconstruction.open(tmp_path / "out")
    assert result.num_frames >= 40 and (np.diff(result.timestamps) > 0).all()


def test_an_address_that_the_server_does_not_know(server: Server, tmp_path: Path) -> None:
    session = LiveSession(Recorder, longer_edge=LONGER_EDGE, warm_up=0, recording=Recording(tmp_path / "out"))
    wrong = server.address.replace("ball", "nothing")
    with pytest.raises(InputError, match=f"^{wrong} cannot be opened .*check address"):
        follow(open_source(wrong), session, progress=False)
    assert list(tmp_path.iterdir()) == []
