"""The server behind the viewer: where it is reached, and how long it runs (extra `viewer`)."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import socket
import time
from pathlib import Path
from typing import Any

from logvggt_jax.errors import InputError, MissingPackage, install_line, one_line
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.viewer.run_window import RunWindow
from logvggt_jax.reconstruction.viewer.window import Window

HOST = "127.0.0.1"
_LAST_PORT, _PORTS_TRIED = 65535, 100


def open_viewer(folder: str | Path, *, host: str = HOST, port: int = 8080) -> Any:
    """Starts a viewer of a reconstruction and returns its server (viser).

    Args:
      folder: output of `logvggt reconstruct`.
      host: name or address at which the page is served; the default is reachable from this machine only.
      port: of the web page; the next free one is taken if it is in use.

    Raises:
      InputError: `folder` holds no reconstruction, or nothing can be served at `host` and `port`.
      MissingPackage: viser is not installed.
    """
    result = Reconstruction.open(folder)
    server = open_server(host, port)
    Window(server, result)
    return server


def watch_run(*, host: str = HOST, port: int = 8080) -> RunWindow:
    """Starts a viewer of a run that is about to begin; the other arguments and errors are those of `open_viewer`."""
    return RunWindow(open_server(host, port))


def check_viewer(host: str, port: int) -> None:
    """Raises what `open_viewer` would for this address, or without viser; nothing is served."""
    _free_port(host, port)
    _viser()


def open_server(host: str, port: int) -> Any:
    """A server (viser) of an empty page; arguments and errors as of `open_viewer`."""
    port, viser = _free_port(host, port), _viser()
    # Browsers open connections ahead and close them unused, which is no error.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with contextlib.redirect_stdout(io.StringIO()):  # a box of its own, where standard output may be data
        return viser.ViserServer(host=host, port=port, verbose=False)


def access_note(host: str, port: int) -> str:
    """What to know of who can reach the page; empty where that is this machine alone."""
    if host in (HOST, "localhost", "::1"):
        return ""
    return (
        f"anyone who reaches {host} over the network can look, without a password or encryption. For yourself alone "
        f"leave --host out and open a tunnel from the machine with the browser: ssh -N -L {port}:localhost:{port} "
        "USER@THIS_MACHINE"
    )


def _viser() -> Any:
    try:
        import viser
    except ImportError as error:
        raise MissingPackage(
            f"the viewer needs viser ({one_line(error)}): {install_line('viewer')}; `logvggt "
            "view RESULT --save page.html` writes a page that needs nothing"
        ) from error
    return viser


def _free_port(host: str, port: int) -> int:
    """The first free port from `port` on.

    Raises InputError where nothing can be served: viser's own thread would die of it and leave its caller waiting.
    """
    if not 1 <= port <= _LAST_PORT:
        raise InputError(f"port must be 1 to {_LAST_PORT}, got {port}")
    for candidate in range(port, min(port + _PORTS_TRIED, _LAST_PORT + 1)):
        try:
            family, *_, address = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0]
            socket.create_server(address, family=family).close()
            return candidate
        except (OSError, UnicodeError) as error:
            if not isinstance(error, OSError) or error.errno != errno.EADDRINUSE:
                reason = getattr(error, "strerror", None) or error
                raise InputError(f"the viewer cannot be served at {host!r}, port {candidate}: {reason}") from error
    raise InputError(f"the viewer cannot be served at {host!r}: every port from {port} to {candidate} is in use")


def serve_until_interrupt() -> None:
    """Blocks until the user interrupts."""
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            time.sleep(1.0)


def stop_server(server: Any) -> None:
    """Ends a server of `open_viewer`, or of the window of `watch_run`, and says nothing."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
