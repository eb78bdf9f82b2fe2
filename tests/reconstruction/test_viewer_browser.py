"""Every control of the viewer does in a browser what it says."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from devtools import Page, opened
from PIL import Image
from room_result import write_room_result

from logvggt_jax.geometry import camera_centres
from logvggt_jax.reconstruction.viewer import open_viewer, stop_server

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::DeprecationWarning")]


def soon(condition: Callable[[], Any]) -> bool:
    """Whether something comes true."""
    end = time.monotonic() + 30
    while not (true := bool(condition())) and time.monotonic() < end:
        time.sleep(0.2)
    return true


def scene(page: Page) -> np.ndarray:
    """Of the picture what is left of the controls and below the notice of slow drawing, [h, w, 3] int."""
    return page.picture()[185:, :440].astype(int)


def coarse(page: Page) -> np.ndarray:
    """The same without detail: a slow browser draws less finely than it did at first."""
    return cv2.resize(scene(page).astype(np.float32), None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA)


def drawn(page: Page, ground: int = 18) -> np.ndarray:
    """The pixels [n, 3] that are not ground."""
    found = scene(page)
    return found[np.abs(found - ground).max(axis=2) > 25]


def test_every_control_changes_the_picture_as_it_says(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    result = write_room_result(tmp_path, count=5, size=(84, 112))
    server = open_viewer(result.folder, port=18380)
    downloads = tmp_path / "downloads"
    downloads.mkdir()
    try:
        with opened(f"http://127.0.0.1:{server.get_port()}/", tmp_path / "profile", downloads) as page:
            assert soon(server.get_clients)
            client = next(iter(server.get_clients().values()))
            assert soon(lambda: len(drawn(page)) > 5000)
            first = coarse(page)

            page.choose("colour", "depth")
            assert soon(lambda: np.abs(coarse(page) - first).mean() > 5)
            page.choose("colour", "image")
            assert soon(lambda: np.abs(coarse(page) - first).mean() < 3)

            count = len(drawn(page))
            page.type("size", 3)
            assert soon(lambda: len(drawn(page)) > 1.1 * count)
            page.type("size", 0.3)
            assert soon(lambda: len(drawn(page)) < 0.8 * count)
            page.type("size", 1)
            page.choose("of 2,000", "200")
            assert soon(lambda: np.abs(coarse(page) - first).mean() > 5)
            page.choose("of 2,000", "2,000")
            assert soon(lambda: np.abs(coarse(page) - first).mean() < 3)

            page.tick("dark ground")
            assert soon(lambda: np.median(scene(page)[:, :40]) > 200)
            page.tick("dark ground")
            assert soon(lambda: np.median(scene(page)[:, :40]) < 50)

            page.type("frame", 3)
            page.press("look through this camera")
            centre = camera_centres(result.extrinsics)[3]
            assert soon(lambda: np.linalg.norm(np.asarray(client.camera.position) - centre) < 1e-3)
            page.tick("its points alone")
            page.tick("play")
            assert soon(lambda: page.value("document.body.innerText").count("view 0,"))
            page.tick("play")
            page.tick("its points alone")

            page.press("where it began")
            assert soon(lambda: np.linalg.norm(np.asarray(client.camera.position) - centre) > 0.01)
            page.press("fly along the cameras")
            last = camera_centres(result.extrinsics)[-1]
            assert soon(lambda: np.linalg.norm(np.asarray(client.camera.position) - last) < 1e-3)

            page.press("screenshot")
            assert soon(lambda: [file for file in downloads.iterdir() if file.suffix == ".png"])
            picture = np.asarray(Image.open(downloads / "result.png"))
            assert picture.shape == (1080, 1920, 3) and picture.std() > 10
    finally:
        stop_server(server)


def test_a_browser_without_webgl_is_told_so(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    result = write_room_result(tmp_path, count=2)
    server = open_viewer(result.folder, port=18390)
    try:
        with opened(
            f"http://127.0.0.1:{server.get_port()}/", tmp_path / "profile", tmp_path, "--disable-3d-apis"
        ) as page:
            assert soon(lambda: "WebGL is unavailable." in page.value("document.body.innerText"))
    finally:
        stop_server(server)
