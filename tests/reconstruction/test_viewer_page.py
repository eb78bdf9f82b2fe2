"""The page without a server holds the scene, is one file, is small enough, and shows something."""

from __future__ import annotations

import base64
import io
import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from devtools import Page, opened
from PIL import Image
from result_folder import write_result
from room_result import write_room_result

from logvggt_jax.errors import InputError, OutputExists
from logvggt_jax.reconstruction.points.cloud_file import VERTEX, write_points
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.viewer import save_page


def wait_until(page: Page, state: str) -> None:
    """Until a page says that it is in this state."""
    end = time.monotonic() + 30
    while page.value("document.body && document.body.dataset.state") != state:
        assert time.monotonic() < end, f"the page is not {state!r}"
        time.sleep(0.1)


def scene_of(page: Path) -> dict[str, Any]:
    """The data of a page."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.S)
    assert found is not None
    return json.loads(found[1])


def decoded(scene: dict[str, Any], name: str, dtype: str, *shape: int) -> np.ndarray:
    """An array of the page."""
    return np.frombuffer(base64.b64decode(scene[name]), dtype).reshape(-1, *shape)


def places(scene: dict[str, Any]) -> np.ndarray:
    """The points [n, 3] of a page in the world."""
    return np.array(scene["origin"]) + decoded(scene, "positions", "<u2", 3) / 65535 * scene["size"]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    """A small room: 2,000 points of five frames."""
    return write_room_result(tmp_path_factory.mktemp("room"), count=5)


def test_a_page_holds_cloud_cameras_and_pictures(room: Reconstruction, tmp_path: Path) -> None:
    page = tmp_path / "room.html"
    assert save_page(room.folder, page) == (2000, 2000)
    scene, cloud = scene_of(page), room.cloud()
    assert cloud.frame is not None and cloud.confidence is not None
    found, colours = places(scene), decoded(scene, "colours", "u1", 3)
    frames = decoded(scene, "steps", "<u2")
    # In the order of the page: each of its points is one of the cloud, to a 65535th of the box, with colour and frame.
    distances = np.abs(found[:, None] - cloud.points[None]).max(axis=2)
    nearest = distances.argmin(axis=1)
    assert distances.min(axis=1).max() < max(scene["size"]) / 65535 and len(set(nearest.tolist())) > 1990
    assert np.mean((colours == cloud.colours[nearest]).all(axis=1)) > 0.99
    assert np.mean(frames == cloud.frame[nearest]) > 0.99
    depth = decoded(scene, "depth", "u1")
    pose = room.extrinsics[cloud.frame[nearest]]
    z = (pose[:, 2, :3] * cloud.points[nearest]).sum(1) + pose[:, 2, 3]
    assert np.mean(np.diff(depth[np.argsort(-z)].astype(int)) >= 0) > 0.99 and set(depth.tolist()) > {0, 128, 255}
    assert [camera["name"] for camera in scene["cameras"]] == list(room.names)
    np.testing.assert_allclose([camera["extrinsics"] for camera in scene["cameras"]], room.extrinsics)
    for pictures, index in zip(scene["pictures"], range(5), strict=True):
        for name in ("image", "depth"):
            picture = Image.open(io.BytesIO(base64.b64decode(pictures[name])))
            assert picture.format == "JPEG" and picture.width == 320
        shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(pictures["image"]))).resize((56, 42)), float)
        assert np.abs(shown - room.image(index)).mean() < 12


def test_a_page_needs_nothing_but_itself(room: Reconstruction, tmp_path: Path) -> None:
    save_page(room.folder, tmp_path / "room.html")
    text = re.sub(r'id="data">.*?</script>', "", (tmp_path / "room.html").read_text(), flags=re.S)
    assert not re.search(r"https?://|<link|<script[^>]+src|@import|import\(|fetch\(|XMLHttp|WebSocket", text)


def test_a_page_is_thinned_until_it_fits(room: Reconstruction, tmp_path: Path) -> None:
    page = tmp_path / "room.html"
    for most in (150_000, 80_000, 55_000):
        shown, stored = save_page(room.folder, page, most_bytes=most, overwrite=True)
        assert stored == 2000 and page.stat().st_size <= most
        assert len(places(scene_of(page))) == shown
    assert 0 < shown < 2000
    # Thinned alike everywhere.
    counts = np.bincount(decoded(scene_of(page), "steps", "<u2"), minlength=5)
    assert counts.min() > 0.6 * counts.max()


def test_stray_points_do_not_coarsen_the_rest(tmp_path: Path) -> None:
    (tmp_path / "result").mkdir()
    write_result(tmp_path / "result")
    vertices = np.zeros(1000, VERTEX)
    vertices["x"] = np.linspace(0, 1, 1000)
    vertices["x"][0] = -1e9
    write_points(tmp_path / "result" / "points.ply", 1000, [vertices])
    assert save_page(tmp_path / "result", tmp_path / "p.html") == (999, 1000)
    np.testing.assert_allclose(np.sort(places(scene_of(tmp_path / "p.html"))[:, 0]), vertices["x"][1:], atol=1e-4)


def test_a_name_cannot_break_the_page(tmp_path: Path) -> None:
    folder = tmp_path / "a<b>&amp;"
    folder.mkdir()
    write_result(folder, 1)
    document = json.loads((folder / "cameras.json").read_text())
    name = "<script>alert(1)<!--"
    document["frames"][0]["name"] = name
    (folder / "cameras.json").write_text(json.dumps(document))
    (folder / "depth" / "0.npz").rename(folder / "depth" / f"{name}.npz")
    (folder / "images" / "0.jpg").rename(folder / "images" / f"{name}.jpg")
    save_page(folder, tmp_path / "p.html")
    text = (tmp_path / "p.html").read_text()
    assert "<title>a&lt;b&gt;&amp;amp;</title>" in text and "alert(1)<" not in text
    assert scene_of(tmp_path / "p.html")["cameras"][0]["name"] == name


def test_a_page_of_an_empty_cloud_of_an_old_result(tmp_path: Path) -> None:
    """Versions before had neither images nor confidence and frame of a point."""
    write_result(tmp_path, 2)
    for image in (tmp_path / "images").iterdir():
        image.unlink()
    (tmp_path / "images").rmdir()
    cloud = (tmp_path / "points.ply").read_bytes().replace(b"vertex 10", b"vertex 0")
    cloud = cloud.replace(b"property float confidence\nproperty int frame\n", b"")
    (tmp_path / "points.ply").write_bytes(cloud[: cloud.index(b"end_header\n") + len(b"end_header\n")])
    assert save_page(tmp_path, tmp_path / "p.html") == (0, 0)
    scene = scene_of(tmp_path / "p.html")
    assert scene["colourings"] == ["image"] and "steps" not in scene and set(scene["pictures"][0]) == {"depth"}


def test_what_cannot_be_saved_is_one_line_and_leaves_what_was_there(room: Reconstruction, tmp_path: Path) -> None:
    page = tmp_path / "room.html"
    page.write_text("mine")
    with pytest.raises(OutputExists, match=r"room\.html exists"):
        save_page(room.folder, page)
    with pytest.raises(InputError, match=r"must end in \.html"):
        save_page(room.folder, tmp_path / "room.txt", overwrite=True)
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        save_page(room.folder, tmp_path / "folder.html", overwrite=True)
    write_result(tmp_path, 2)
    (tmp_path / "depth" / "1.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"1\.npz: no depth file"):
        save_page(tmp_path, page, overwrite=True)
    vertices = np.zeros(1, VERTEX)
    vertices["frame"] = 2
    write_points(tmp_path / "points.ply", 1, [vertices])
    with pytest.raises(InputError, match="it has points of frame 2, there are 2"):
        save_page(tmp_path, page, overwrite=True)
    assert page.read_text() == "mine"


@pytest.mark.slow
def test_a_browser_draws_the_page(room: Reconstruction, tmp_path: Path) -> None:
    page = tmp_path / "room.html"
    save_page(room.folder, page)
    with opened(page.as_uri(), tmp_path / "with", tmp_path) as browser:
        wait_until(browser, "drawn")
        picture = browser.picture()
    # Left of the controls there is more than the ground, and it has the room's colours.
    scene = picture[:, :500]
    drawn = np.abs(scene.astype(int) - 0x12).max(axis=2) > 25
    assert 0.1 < drawn.mean() < 0.98 and scene[drawn].std(axis=0).min() > 10
    with opened(page.as_uri(), tmp_path / "without", tmp_path, "--disable-3d-apis") as browser:
        wait_until(browser, "no WebGL")
        without = browser.picture()
    # A line of text on an even ground.
    assert 0.001 < (np.abs(without.astype(int) - 0x12).max(axis=2) > 25).mean() < 0.06


@pytest.mark.slow
def test_the_page_is_used_on_a_phone_and_by_keyboard(room: Reconstruction, tmp_path: Path) -> None:
    file = tmp_path / "room.html"
    save_page(room.folder, file)
    with opened("about:blank", tmp_path / "profile", tmp_path) as page:
        page.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True)
        page.call("Page.navigate", url=file.as_uri())
        wait_until(page, "drawn")
        # The controls are out of the way until they are asked for.
        height = "document.getElementById('panel').clientHeight"
        assert page.value(height) < 60
        page.press("+")
        assert page.value(height) > 300
        page.value("document.getElementById('fold').click()")
        first = page.picture().astype(int)
        # In a tall window the first picture's whole width is there: what is at its edges lies beside the middle.
        drawn = np.abs(first[100:] - 0x12).max(axis=2) > 25
        rows = np.flatnonzero(drawn.any(axis=1))
        assert rows[-1] - rows[0] < 500
        page.value("document.getElementById('canvas').focus()")
        for kind in ("keyDown", "keyUp"):
            page.call("Input.dispatchKeyEvent", type=kind, key="ArrowLeft", code="ArrowLeft", windowsVirtualKeyCode=37)
        time.sleep(0.5)
        assert np.abs(page.picture().astype(int) - first)[100:-100, 20:-20].mean() > 1
        page.value("hidden.value = 40; hidden.dispatchEvent(new Event('input'))")
        assert page.value("document.getElementById('share').textContent") == "hide 40 %"
