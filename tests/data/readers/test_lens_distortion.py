"""Recordings whose lenses distort: frames are what a pinhole with the recording's focal lengths sees."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from analytic_room import pinhole
from room_views import millimetres, write_image

from logvggt_jax.data import open_dataset
from logvggt_jax.data.errors import AbsurdIntrinsics
from logvggt_jax.data.formats.lens import Lens
from logvggt_jax.data.readers.own_recordings import without_distortion
from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames

SIZE = HEIGHT, WIDTH = 120, 160
INTRINSICS = pinhole(SIZE, 110.0, (81.25, 57.5))
PICTURE, DEPTH = "images/frame.png", "depth/frame.png"

Writer = Callable[[Path], None]


def colmap(camera: str) -> Writer:
    """`camera`: model and parameters, of which focal lengths and principal point are filled in."""
    fx, fy, cx, cy = (INTRINSICS[place] for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    model, _, distortion = camera.partition(" ")
    focal = f"{fx} {fy}" if model in ("OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "FISHEYE") else f"{fx}"

    def write(root: Path) -> None:
        (root / "sparse").mkdir()
        # COLMAP's first pixel has its centre at (0.5, 0.5).
        own = f"1 {model} {WIDTH} {HEIGHT} {focal} {cx + 0.5} {cy + 0.5} {distortion}\n"
        (root / "sparse/cameras.txt").write_text(own)
        (root / "sparse/images.txt").write_text("1 1 0 0 0 0 0 0 1 frame.png\n\n")

    return write


def nerfstudio(**camera: float | str) -> Writer:
    def write(root: Path) -> None:
        size = {"w": WIDTH, "h": HEIGHT, "fl_x": INTRINSICS[0, 0], "fl_y": INTRINSICS[1, 1]}
        centre = {"cx": INTRINSICS[0, 2] + 0.5, "cy": INTRINSICS[1, 2] + 0.5}
        frame = {"file_path": PICTURE, "depth_file_path": DEPTH, "transform_matrix": np.eye(4).tolist()}
        content = {"camera_model": "OPENCV", **size, **centre, **camera, "frames": [frame]}
        (root / "transforms.json").write_text(json.dumps(content))

    return write


def tum(**distortion: float) -> Writer:
    def write(root: Path) -> None:
        fx, fy, cx, cy = (INTRINSICS[place] for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
        values = {"width": WIDTH, "height": HEIGHT, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_scale": 1000}
        lines = (f"{name} {value}\n" for name, value in {**values, **distortion}.items())
        (root / "calibration.txt").write_text("".join(lines))
        (root / "rgb.txt").write_text(f"0.0 {PICTURE}\n")
        (root / "depth.txt").write_text(f"0.0 {DEPTH}\n")
        (root / "groundtruth.txt").write_text("0.0 0 0 0 0 0 0 1\n")

    return write


def read(root: Path, name: str, write: Writer, picture: np.ndarray, depth: np.ndarray) -> Frames:
    write(root)
    write_image(root / PICTURE, picture)
    write_image(root / DEPTH, millimetres(depth))
    return open_dataset(name, root).read(root.name, [0])


def projected(points: np.ndarray, coefficients: list[float], *, fisheye: bool) -> np.ndarray:
    """Where OpenCV's lens shows points [n, 3], pixels [n, 2]."""
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    return project(points[:, None], np.zeros(3), np.zeros(3), INTRINSICS, np.array(coefficients))[0][:, 0]


def distances(pixels: np.ndarray) -> np.ndarray:
    """From every pixel of the picture to each of [n, 2], [n, H, W]."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.hypot(columns - pixels[:, 0, None, None], rows - pixels[:, 1, None, None])


FULL = [0.1, -0.05, 0.004, -0.003, 0.02, 0.03, -0.02, 0.01]
CASES = [
    ("colmap", colmap("SIMPLE_RADIAL -0.15"), [-0.15, 0, 0, 0], False),
    ("colmap", colmap("RADIAL 0.1 -0.03"), [0.1, -0.03, 0, 0], False),
    ("colmap", colmap("OPENCV -0.1 0.03 0.01 -0.02"), [-0.1, 0.03, 0.01, -0.02], False),
    ("colmap", colmap(f"FULL_OPENCV {' '.join(map(str, FULL))}"), FULL, False),
    ("colmap", colmap("OPENCV_FISHEYE 0.02 -0.01 0.003 0.001"), [0.02, -0.01, 0.003, 0.001], True),
    ("colmap", colmap("SIMPLE_RADIAL_FISHEYE 0.03"), [0.03, 0, 0, 0], True),
    ("colmap", colmap("RADIAL_FISHEYE 0.03 -0.01"), [0.03, -0.01, 0, 0], True),
    ("colmap", colmap("FISHEYE"), [0.0] * 4, True),
    ("nerfstudio", nerfstudio(k1=-0.1, k2=0.02, k3=0.01, p1=0.01, p2=-0.01), [-0.1, 0.02, 0.01, -0.01, 0.01], False),
    ("nerfstudio", nerfstudio(camera_model="SIMPLE_RADIAL", k1=0.1), [0.1, 0, 0, 0], False),
    (
        "nerfstudio",
        nerfstudio(camera_model="OPENCV_FISHEYE", k1=0.02, k2=-0.01, k3=0.003, k4=0.001),
        [0.02, -0.01, 0.003, 0.001],
        True,
    ),
    # As instant-ngp writes it.
    ("nerfstudio", nerfstudio(camera_model=None, is_fisheye=True, k1=0.02, k2=-0.01), [0.02, -0.01, 0, 0], True),
    ("tum_recording", tum(k1=-0.1, k2=0.02, p1=0.01, p2=-0.01, k3=0.01), [-0.1, 0.02, 0.01, -0.01, 0.01], False),
]


@pytest.mark.parametrize(("name", "write", "coefficients", "fisheye"), CASES)
def test_points_are_where_the_pinhole_says(
    name: str, write: Writer, coefficients: list[float], fisheye: bool, tmp_path: Path
) -> None:
    generator = np.random.default_rng(0)
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-0.5, 0.48, 5), np.linspace(-0.35, 0.38, 4)))
    z = generator.uniform(1.0, 3.0, x.size).round(3)
    points = np.stack([x * z, y * z, z], axis=1)
    stored, expected = projected(points, coefficients, fisheye=fisheye), points @ INTRINSICS.T / z[:, None]
    expected = expected[:, :2]
    assert np.abs(stored - expected).max() > 1.0
    blobs = 250 * np.exp(-0.5 * (distances(stored) / 2.0) ** 2).sum(0)
    depth = (z[:, None, None] * (distances(stored) < 4.0)).max(0)
    frames = read(tmp_path, name, write, np.repeat(blobs[..., None], 3, axis=2).round().astype(np.uint8), depth)

    np.testing.assert_allclose(frames.intrinsics[0], INTRINSICS, rtol=1e-6)
    weights = frames.images[0, ..., 0] * (distances(expected) < 8.0)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    found = np.stack([(weights * each).sum((1, 2)) / weights.sum((1, 2)) for each in (columns, rows)], axis=1)
    # A blob is not quite round after it, which moves its centre a little.
    np.testing.assert_allclose(found, expected, atol=0.15)
    at = expected.round().astype(int)
    np.testing.assert_allclose(frames.depth[0][at[:, 1], at[:, 0]], z, atol=6e-4)
    assert set(np.unique(frames.depth[0]).round(3)) <= {0.0, *z.astype(np.float32).round(3)}, "never between surfaces"


@pytest.mark.parametrize(("write", "coefficients", "fisheye"), [case[1:] for case in CASES if case[0] == "colmap"])
def test_colmap_means_what_opencv_does(write: Writer, coefficients: list[float], fisheye: bool, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    write(tmp_path)
    _, model, width, height, *parameters = (tmp_path / "sparse/cameras.txt").read_text().split()
    camera = pycolmap.Camera(model=model, width=int(width), height=int(height), params=[*map(float, parameters)])
    points = np.array([[0.3, -0.2, 1.0], [-0.8, 0.9, 2.0], [0.0, 0.0, 3.0]])
    theirs = np.array([camera.img_from_cam(point) for point in points]) - 0.5
    np.testing.assert_allclose(theirs, projected(points, coefficients, fisheye=fisheye), atol=1e-6)


def test_what_the_lens_has_not_seen_is_black_and_has_no_depth(tmp_path: Path) -> None:
    white = np.full((*SIZE, 3), 255, np.uint8)
    frames = read(tmp_path, "colmap", colmap("SIMPLE_RADIAL 0.2"), white, np.full(SIZE, 2.0))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([columns, rows, np.ones(SIZE)], axis=-1).reshape(-1, 3) @ np.linalg.inv(INTRINSICS).T
    x, y = projected(rays, [0.2, 0, 0, 0], fisheye=False).T.reshape(2, *SIZE)
    seen = (np.abs(x - (WIDTH - 1) / 2) <= WIDTH / 2) & (np.abs(y - (HEIGHT - 1) / 2) <= HEIGHT / 2)
    assert 0.5 < seen.mean() < 0.95
    np.testing.assert_array_equal(frames.depth[0] > 0, seen)
    np.testing.assert_array_equal(frames.images[0], np.where(seen[..., None], white, 0))


def test_beyond_where_a_polynomial_turns_around_there_is_nothing(tmp_path: Path) -> None:
    """r (1 - 0.9 r²) is largest at 0.61, and shows what is within a second time."""
    white = np.full((*SIZE, 3), 255, np.uint8)
    frames = read(tmp_path, "colmap", colmap("SIMPLE_RADIAL -0.9"), white, np.full(SIZE, 2.0))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    radius = np.hypot(columns - INTRINSICS[0, 2], rows - INTRINSICS[1, 2]) / INTRINSICS[0, 0]
    turn = (1 / 2.7) ** 0.5
    assert not frames.depth[0][radius > turn + 0.01].any() and frames.depth[0][radius < turn - 0.01].all()


def test_a_resized_copy_is_undistorted_in_its_own_pixels(tmp_path: Path) -> None:
    colmap("OPENCV -0.1 0.03 0.01 -0.02")(tmp_path)
    ramp = np.broadcast_to(np.arange(2 * WIDTH, dtype=np.float32)[:, None] / 2, (2 * HEIGHT, 2 * WIDTH, 3))
    write_image(tmp_path / PICTURE, ramp.astype(np.uint8))
    large = open_dataset("colmap", tmp_path).read(tmp_path.name, [0])
    write_image(tmp_path / PICTURE, ramp[::2, ::2].astype(np.uint8))
    small = open_dataset("colmap", tmp_path).read(tmp_path.name, [0])
    assert large.intrinsics[0, 0, 0] == pytest.approx(2 * small.intrinsics[0, 0, 0])
    halved = large.images[0].reshape(HEIGHT, 2, WIDTH, 2, 3).mean((1, 3))
    inner = np.s_[8:-8, 8:-8]
    np.testing.assert_allclose(small.images[0][inner], halved[inner], atol=2)


def test_a_lens_that_leaves_nothing_is_named(tmp_path: Path) -> None:
    with pytest.raises(AbsurdIntrinsics, match=r"cameras\.txt: nothing of frame\.png is left without its distortion"):
        read(tmp_path, "colmap", colmap("SIMPLE_RADIAL -1e9"), np.zeros((*SIZE, 3), np.uint8), np.ones(SIZE))


def test_a_picture_that_opencv_cannot_map_is_refused() -> None:
    record: Any = SimpleNamespace(lens=Lens((0.1,)).row, image=Path("wide.png"))
    picture = np.zeros((2, 2**15, 3), np.uint8)
    with pytest.raises(InputError, match=r"wide\.png: 32768 x 2 pixels with lens distortion.* make it smaller"):
        without_distortion(record, picture, np.zeros(picture.shape[:2], np.float32), INTRINSICS)
