"""A reconstruction in the browser: point cloud and cameras (extra `viewer`)."""

from __future__ import annotations

import errno
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.errors import InputError, MissingPackage, install_line
from logvggt_jax.geometry import camera_centres, matrix_to_quaternion
from logvggt_jax.reconstruction.result import Reconstruction

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
    points, colours = result.points()
    port = _free_port(host, port)
    try:
        import viser
    except ImportError as error:
        raise MissingPackage(f"the viewer needs viser: {install_line('viewer')}") from error

    centres = camera_centres(result.extrinsics)
    shown = points[:: max(1, len(points) // 10_000)].astype(np.float64)
    span = float(np.ptp(np.concatenate([centres, shown]), axis=0).max())
    server = viser.ViserServer(host=host, port=port, verbose=False)
    server.scene.set_up_direction("-y")
    server.scene.add_point_cloud("/points", points, colours, point_size=span / 1000)
    height, width = result.image_size
    quaternions = matrix_to_quaternion(np.swapaxes(result.extrinsics[:, :3, :3], -1, -2))
    for index, (x, y, z, w) in enumerate(quaternions):
        server.scene.add_camera_frustum(
            f"/cameras/{index:06d}",
            fov=2 * float(np.arctan(height / 2 / result.intrinsics[index, 1, 1])),
            aspect=width / height,
            scale=span / 40,
            wxyz=(w, x, y, z),
            position=tuple(centres[index]),
        )
    if len(centres) > 1:
        segments = np.stack([centres[:-1], centres[1:]], axis=1)
        server.scene.add_line_segments("/trajectory", segments, colors=(230, 60, 40))
    return server


def access_note(host: str, port: int) -> str:
    """What to know of who can reach the page; empty where that is this machine alone."""
    if host in (HOST, "localhost", "::1"):
        return ""
    return (
        f"anyone who reaches {host} over the network can look, without a password or encryption. For yourself alone "
        f"leave --host out and open a tunnel from the machine with the browser: ssh -N -L {port}:localhost:{port} "
        "USER@THIS_MACHINE"
    )


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


def serve_forever(server: Any) -> None:
    """Blocks until the user interrupts, then stops the server."""
    try:
        while True:
            time.sleep(1.0)
    except KeyboardInterrupt:
        server.stop()
