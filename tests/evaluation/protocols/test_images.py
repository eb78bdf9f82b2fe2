"""Images for the network against the sizes, intrinsics and pixels of the public reference code."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from logvggt_jax.evaluation.protocols.images import (
    Fit,
    PrincipalPointCrop,
    WholePicture,
    WidthResize,
    crop_about_principal_point,
)
from logvggt_jax.types import Frames

CROPS = ("seven_scenes_518", "nrgbd_518", "seven_scenes_512", "off_centre", "wide")


def frames(height: int, width: int, count: int = 1) -> Frames:
    rng = np.random.default_rng(0)
    intrinsics = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], np.float32)
    return Frames(
        images=rng.integers(0, 255, (count, height, width, 3), np.uint8),
        depth=rng.uniform(1, 2, (count, height, width)).astype(np.float32),
        intrinsics=np.tile(intrinsics, (count, 1, 1)),
        extrinsics=np.tile(np.eye(4, dtype=np.float32), (count, 1, 1)),
        metric=True,
    )


@pytest.fixture
def golden(golden_dir: Path) -> tuple[dict[str, Any], Any]:
    cases = json.loads((golden_dir / "metrics" / "preprocess_io.json").read_text())["cases"]
    return {case["id"]: case for case in cases}, np.load(golden_dir / "metrics" / "preprocess_io.npz")


@pytest.mark.parametrize("name", CROPS)
def test_crop_equals_the_reference(golden: tuple[dict[str, Any], Any], name: str) -> None:
    cases, arrays = golden
    (width, height), (out_width, out_height) = (cases[name]["params"][key] for key in ("size_wh", "resolution_wh"))
    # A depth that names its own pixel shows where every pixel of the result comes from.
    depth = np.arange(height * width, dtype=np.float64).reshape(height, width)
    image, depth, intrinsics = crop_about_principal_point(
        np.zeros((height, width, 3), np.uint8), depth, arrays[f"{name}/K"].astype(np.float64), (out_height, out_width)
    )
    assert image.shape == (out_height, out_width, 3)
    np.testing.assert_allclose(intrinsics, arrays[f"{name}/K_out"], atol=cases[name]["tol_abs"])
    np.testing.assert_array_equal(depth[:, 0] // width, arrays[f"{name}/src_row_of_out_row"])
    np.testing.assert_array_equal(depth[0] % width, arrays[f"{name}/src_col_of_out_col"])


def test_sizes_equal_the_reference(golden: tuple[dict[str, Any], Any]) -> None:
    compared = 0
    for case in golden[0]["eval_image_sizes"]["expected"]:
        source = tuple(case["size_wh"][::-1])
        assert WidthResize().size(source) == tuple(case["vggt_load_and_preprocess_crop_hw"])
        if not isinstance(case["patch14_518_resize_hw"], str):
            assert WholePicture().size(source) == tuple(case["patch14_518_resize_hw"])
            compared += 1
    assert compared >= 5


@pytest.mark.parametrize("rule", [PrincipalPointCrop(70), WholePicture(70), WidthResize(70), Fit((56, 70))])
@pytest.mark.parametrize("source", [(60, 80), (80, 60), (48, 48), (33, 120)])
def test_images_are_multiples_of_fourteen_and_as_announced(rule: Any, source: tuple[int, int]) -> None:
    made = rule(frames(*source, count=2))
    assert made.images.dtype == np.uint8
    assert made.images.shape[1] % 14 == made.images.shape[2] % 14 == 0
    assert made.images.shape[1:3] == rule.size(source) and max(made.images.shape[1:3]) <= 70
    kept = made.depth.shape == made.images.shape[:3]
    assert kept if rule.keeps_grid else made.depth.shape == (2, *source)


@given(st.integers(40, 90), st.integers(40, 90), st.floats(0.35, 0.65), st.floats(0.35, 0.65))
@settings(deadline=None, max_examples=30)
def test_points_land_on_their_pixels_to_a_pixel(height: int, width: int, x: float, y: float) -> None:
    intrinsics = np.array([[70.0, 0, x * width], [0, 70.0, y * height], [0, 0, 1]])
    pixel = np.arange(height * width, dtype=np.float64).reshape(height, width)
    _, source, cropped = crop_about_principal_point(np.zeros((height, width, 3), np.uint8), pixel, intrinsics, (28, 42))
    rows, columns = np.divmod(source, width)
    # The ray of a pixel of the result and that of the pixel it was taken from are one ray.
    ray_u = (np.arange(42) - cropped[0, 2]) / cropped[0, 0]
    ray_v = (np.arange(28) - cropped[1, 2]) / cropped[1, 1]
    assert np.abs(ray_u * 70 + intrinsics[0, 2] - columns[0]).max() < 1.0 + 1.0 / (cropped[0, 0] / 70)
    assert np.abs(ray_v * 70 + intrinsics[1, 2] - rows[:, 0]).max() < 1.0 + 1.0 / (cropped[1, 1] / 70)


def test_whole_pictures_keep_their_mean_colour_and_their_borders() -> None:
    picture = np.zeros((60, 80, 3), np.uint8)
    picture[:, 40:] = 200
    made = WholePicture(42)(frames(60, 80)._replace(images=picture[None])).images[0]
    assert made.shape == (28, 42, 3) and abs(float(made.mean()) - 100.0) < 1.0
    assert (made[:, :18] < 20).all() and (made[:, 24:] > 180).all()


def test_a_principal_point_outside_the_picture_is_named() -> None:
    broken = frames(48, 64)
    broken.intrinsics[0, 0, 2] = 70.0
    with pytest.raises(ValueError, match=r"principal point \(70, 24\) lies outside"):
        PrincipalPointCrop(42)(broken)
