"""The viewer shows what was reconstructed, to this machine only."""

from __future__ import annotations

import urllib.request
from pathlib import Path

import numpy as np
import pytest

from logvggt_jax.reconstruction.point_cloud import VERTEX, write_point_cloud
from logvggt_jax.reconstruction.trajectory_files import write_cameras
from logvggt_jax.reconstruction.viewer import open_viewer


def write_reconstruction(folder: Path, count: int = 3) -> None:
    extrinsics = np.tile(np.eye(4)[:3], (count, 1, 1))
    extrinsics[:, 0, 3] = np.arange(count)
    intrinsics = np.tile(np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), (count, 1, 1))
    write_cameras(
        folder / "cameras.json",
        names=[str(i) for i in range(count)],
        timestamps=list(range(count)),
        extrinsics=extrinsics,
        intrinsics=intrinsics,
        image_size=(48, 64),
        model_intrinsics=intrinsics,
        model_size=(48, 64),
    )
    vertices = np.zeros(10, VERTEX)
    vertices["z"] = np.arange(10)
    write_point_cloud(folder / "points.ply", [vertices])


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_page_is_served_to_this_machine_only(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    write_reconstruction(tmp_path)
    server = open_viewer(tmp_path, port=18080)
    try:
        assert server.get_host() == "127.0.0.1"
        with urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}/", timeout=10) as page:
            assert page.status == 200
    finally:
        server.stop()


def test_a_folder_without_reconstruction_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"cameras\.json does not exist"):
        open_viewer(tmp_path)
