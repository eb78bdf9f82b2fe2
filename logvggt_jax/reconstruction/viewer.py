"""A reconstruction in the browser: point cloud and cameras (extra `viewer`)."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.errors import MissingInput, MissingPackage
from logvggt_jax.geometry import camera_centres, matrix_to_quaternion
from logvggt_jax.reconstruction.reconstruct import CAMERAS_FILE, POINTS_FILE
from logvggt_jax.reconstruction.trajectory_files import read_cameras

HOST = "127.0.0.1"


def open_viewer(folder: str | Path, *, port: int = 8080) -> Any:
    """Starts a viewer of a reconstruction and returns its server (viser), reachable from this machine only.

    Args:
      folder: output of `logvggt reconstruct`.
      port: of the web page; the next free one is taken if it is in use.

    Raises:
      FileNotFoundError: `folder` holds no reconstruction.
      ImportError: viser is not installed.
    """
    folder = Path(folder)
    cameras = read_cameras(folder / CAMERAS_FILE)
    points, colours = read_points(folder / POINTS_FILE)
    try:
        import viser
    except ImportError as error:
        raise MissingPackage('the viewer needs viser: pip install "logvggt-jax[viewer]"') from error

    extrinsics = np.stack([frame["extrinsics"] for frame in cameras["frames"]])
    centres = camera_centres(extrinsics)
    span = float(np.ptp(np.concatenate([centres, points[:: max(1, len(points) // 10_000)]]), axis=0).max())
    server = viser.ViserServer(host=HOST, port=port, verbose=False)
    server.scene.set_up_direction("-y")
    server.scene.add_point_cloud("/points", points, colours, point_size=span / 1000)
    height, width = cameras["image_size"]
    quaternions = matrix_to_quaternion(np.swapaxes(extrinsics[:, :3, :3], -1, -2))
    for index, frame in enumerate(cameras["frames"]):
        x, y, z, w = quaternions[index]
        server.scene.add_camera_frustum(
            f"/cameras/{index:06d}",
            fov=2 * float(np.arctan(height / 2 / frame["intrinsics"][1, 1])),
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


def read_points(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] float32 and colours [N, 3] uint8 of a PLY file of `write_point_cloud`.

    Raises:
      FileNotFoundError: no such file.
    """
    from plyfile import PlyData

    if not Path(path).is_file():
        raise MissingInput(f"{path} does not exist: expected the output of `logvggt reconstruct`")
    vertices = PlyData.read(str(path))["vertex"].data
    points = np.stack([vertices[name] for name in "xyz"], axis=-1)
    return points, np.stack([vertices[name] for name in ("red", "green", "blue")], axis=-1)
