"""A reconstruction in the browser: point cloud and cameras (extra `viewer`)."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.errors import MissingPackage
from logvggt_jax.geometry import camera_centres, matrix_to_quaternion
from logvggt_jax.reconstruction.result import Reconstruction

HOST = "127.0.0.1"


def open_viewer(folder: str | Path, *, port: int = 8080) -> Any:
    """Starts a viewer of a reconstruction and returns its server (viser), reachable from this machine only.

    Args:
      folder: output of `logvggt reconstruct`.
      port: of the web page; the next free one is taken if it is in use.

    Raises:
      InputError: `folder` holds no reconstruction.
      MissingPackage: viser is not installed.
    """
    result = Reconstruction.open(folder)
    points, colours = result.points()
    try:
        import viser
    except ImportError as error:
        raise MissingPackage('the viewer needs viser: pip install "logvggt-jax[viewer]"') from error

    centres = camera_centres(result.extrinsics)
    span = float(np.ptp(np.concatenate([centres, points[:: max(1, len(points) // 10_000)]]), axis=0).max())
    server = viser.ViserServer(host=HOST, port=port, verbose=False)
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


def serve_forever(server: Any) -> None:
    """Blocks until the user interrupts, then stops the server."""
    try:
        while True:
            time.sleep(1.0)
    except KeyboardInterrupt:
        server.stop()
