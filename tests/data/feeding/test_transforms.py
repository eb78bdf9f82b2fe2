"""Resizing matches the reference filter, and cameras follow pixels."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from logvggt_jax.data.feeding.transforms import ResizeTransform, fit, nearest_size, preprocess, resize
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.frames import Frames
from logvggt_jax.geometry import project, unproject


@pytest.mark.parametrize(("longer_edge", "name"), [(98, "pil_70x98"), (112, "pil_84x112")])
def test_preprocessing_matches_the_reference_loader(golden_dir: Path, longer_edge: int, name: str):
    golden = np.load(golden_dir / "vggt_preprocess.npz", allow_pickle=False)
    images, transform = preprocess(golden["src"][None], longer_edge=longer_edge)
    assert images.shape == (1, *golden[name].shape) and images.dtype == np.float32
    assert transform == ResizeTransform((120, 160), golden[name].shape[:2])
    difference = np.abs(images[0] * 255.0 - golden[name].astype(np.float32))
    assert difference.max() < 1.01 and difference.mean() < 0.01


def bicubic(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The antialiased bicubic filter (a = -0.5) as a product with a matrix of weights, 8 bits between the axes."""
    for axis in (1, 0):
        old, new = picture.shape[axis], size[axis]
        centres = (np.arange(new) + 0.5) * old / new - 0.5
        distance = np.abs(np.arange(old) - centres[:, None]) * min(new / old, 1.0)
        near = (1.5 * distance - 2.5) * distance**2 + 1.0
        far = ((-0.5 * distance + 2.5) * distance - 4.0) * distance + 2.0
        weights = np.where(distance < 1.0, near, np.where(distance < 2.0, far, 0.0))
        product = np.tensordot(weights / weights.sum(1, keepdims=True), np.moveaxis(picture, axis, 0), 1)
        picture = np.moveaxis(np.clip(np.floor(product + 0.5), 0, 255), 0, axis)
    return picture


@pytest.mark.parametrize("size", [(480, 640), (60, 45), (100, 700), (31, 30)])
def test_preprocessing_is_the_bicubic_filter_to_a_grey_level(size: tuple[int, int]):
    rng = np.random.default_rng(0)
    wave = 128 + 120 * np.sin(np.add.outer(np.arange(size[0]) / 3, np.arange(size[1]) / 5))
    checker = 255.0 * (np.add.outer(np.arange(size[0]) // 4, np.arange(size[1]) // 4) % 2)
    picture = np.stack([wave, checker, rng.integers(0, 256, size)], axis=-1).astype(np.uint8)
    images, transform = preprocess([picture], longer_edge=112)
    difference = np.abs(images[0] * 255.0 - bicubic(picture, transform.size))
    assert images.dtype == np.float32 and difference.max() < 1.01 and difference.mean() < 0.05


def test_bytes_in_bytes_out_gives_the_grey_levels_of_preprocessing():
    picture = np.random.default_rng(0).integers(0, 256, (60, 45, 3), np.uint8)
    resized, transform = resize(picture, longer_edge=112)
    images, same = preprocess([picture], longer_edge=112)
    assert resized.dtype == np.uint8 and transform == same
    np.testing.assert_array_equal(images[0], resized / np.float32(255))


def test_pictures_that_fit_are_not_changed():
    picture = np.random.default_rng(0).integers(0, 256, (28, 56, 3), np.uint8)
    images, _ = preprocess([picture], longer_edge=56)
    assert np.array_equal(images[0], picture / np.float32(255))


def test_enlarging_keeps_values_in_range_and_constants_constant():
    checker = np.kron(np.indices((7, 9)).sum(0) % 2, np.ones((4, 4)))[..., None].repeat(3, 2).astype(np.uint8) * 255
    images, _ = preprocess([checker, np.full_like(checker, 200)], longer_edge=140)
    assert images.min() == 0 and images.max() == 1
    assert np.array_equal(images[1], np.full_like(images[1], 200 / np.float32(255)))


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((480, 640), (392, 518)),
        ((640, 480), (518, 392)),
        ((375, 1242), (154, 518)),
        ((436, 1024), (224, 518)),
        ((100, 100), (518, 518)),
        ((3, 700), (14, 518)),
    ],
)
def test_the_longer_edge_becomes_518_and_the_other_a_multiple_of_14(size, expected):
    images, transform = preprocess(np.zeros((1, *size, 3), np.uint8))
    assert images.shape == (1, *expected, 3)
    assert transform.size == expected and transform.original_size == size


@pytest.mark.parametrize(
    ("frames", "complaint"),
    [
        (np.zeros((2, 30, 40, 3), np.float32), "uint8"),
        (np.zeros((30, 40, 3), np.uint8), "frame 0"),
        (np.zeros((1, 30, 40, 4), np.uint8), "frame 0"),
        ([np.zeros((30, 40, 3), np.uint8), np.zeros((31, 40, 3), np.uint8)], "frame 1 has size"),
        ([], "no frames"),
        (np.zeros((1, 0, 40, 3), np.uint8), "empty"),
    ],
)
def test_what_is_no_picture_is_refused(frames, complaint: str):
    with pytest.raises(ValueError, match=complaint):
        preprocess(frames)


def test_the_longer_edge_must_be_whole_patches():
    with pytest.raises(ValueError, match="multiple of 14"):
        preprocess(np.zeros((1, 30, 40, 3), np.uint8), longer_edge=100)


def random_frames(rng: np.random.Generator, height: int, width: int) -> Frames:
    focal = rng.uniform(0.5, 1.5) * width
    matrix = np.array([[focal, 0, 0], [0, focal * rng.uniform(0.9, 1.1), 0], [0, 0, 1]])
    matrix[:2, 2] = rng.uniform(0.35, 0.65, 2) * [width, height]
    return Frames(
        images=rng.integers(0, 256, (1, height, width, 3), np.uint8),
        depth=rng.uniform(1, 4, (1, height, width)).astype(np.float32),
        intrinsics=matrix[None].astype(np.float32),
        extrinsics=np.eye(4, dtype=np.float32)[None],
        metric=True,
    )


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), height=st.integers(30, 150), width=st.integers(30, 150))
def test_points_project_to_the_transformed_pixels(seed: int, height: int, width: int):
    rng = np.random.default_rng(seed)
    frames = random_frames(rng, height, width)
    points = rng.uniform([-1, -1, 1], [1, 1, 4], (20, 3))
    original, _ = project(points, frames.intrinsics[0].astype(np.float64))

    _, transform = preprocess(frames.images, longer_edge=98)
    resized = transform.intrinsics_from_original(frames.intrinsics[0].astype(np.float64))
    np.testing.assert_allclose(project(points, resized)[0], transform.pixels_from_original(original), atol=1e-6)
    np.testing.assert_allclose(transform.pixels_to_original(transform.pixels_from_original(original)), original)
    np.testing.assert_allclose(transform.intrinsics_to_original(resized), frames.intrinsics[0], rtol=1e-6)

    fitted = fit(frames, (42, 56))
    assert fitted.images.shape == (1, 42, 56, 3) and fitted.depth.shape == (1, 42, 56)
    np.testing.assert_array_equal(fitted.intrinsics[0, :2, 2], [28, 21])
    # The crop is one scale and one shift, and nothing of it lies outside the original.
    cropped, _ = project(points, fitted.intrinsics[0].astype(np.float64))
    scale = fitted.intrinsics[0, 0, 0] / frames.intrinsics[0, 0, 0]
    shift = cropped - scale * original
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-4)
    corners = (np.array([[-0.5, -0.5], [55.5, 41.5]]) - shift[0]) / scale
    assert corners.min() > -0.501
    assert corners[1, 0] < width - 0.499 and corners[1, 1] < height - 0.499


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
@example(680)
def test_resampled_pictures_follow_their_cameras(seed: int):
    """A picture that shows its own ray directions still does after fitting."""
    rng = np.random.default_rng(seed)
    frames = random_frames(rng, 120, 160)
    rays = unproject(np.ones((1, 120, 160)), frames.intrinsics.astype(np.float64))
    frames.images[..., :2] = np.rint((rays[..., :2] + 1.5) * 80)
    frames.depth[:] = rays[..., 0] + 3
    fitted = fit(frames, (56, 70))
    expected = unproject(np.ones((1, 56, 70)), fitted.intrinsics.astype(np.float64))
    pixel = 1 / fitted.intrinsics[0, 0, 0]
    # Two border pixels see a cut-off filter; half a grey level is 1/160.
    inner = (slice(None), slice(2, -2), slice(2, -2))
    assert np.abs(fitted.images[..., :2] / 80 - 1.5 - expected[..., :2])[inner].max() < 1.2 / 80
    # A slope of two levels a pixel may be rounded the same way throughout, like a shift, but for levels that waver.
    frames.images[..., :2] = np.floor((rays[..., :2] + 1.5) * 80 + rng.random(rays[..., :2].shape))
    wavering = (fit(frames, (56, 70)).images[..., :2] / 80 - 1.5 - expected[..., :2])[inner]
    assert np.abs(wavering.mean()) < 0.3 / 80
    # Nearest depth is at most half an original pixel off.
    source_pixel = 1 / frames.intrinsics[0, 0, 0]
    assert np.abs(fitted.depth - 3 - expected[..., 0]).max() < 0.51 * source_pixel + 0.01 * pixel


def test_intrinsics_in_whole_numbers_are_numbers_too():
    transform = ResizeTransform((480, 640), (392, 518))
    whole = np.array([[525, 0, 320], [0, 525, 240], [0, 0, 1]])
    np.testing.assert_array_equal(
        transform.intrinsics_from_original(whole), transform.intrinsics_from_original(whole.astype(np.float64))
    )


def test_frames_that_fit_are_returned_as_they_are():
    rooms = Rooms("val", height=28, width=42, num_frames=2, num_rooms=1)
    frames = rooms.read(rooms.sequences[0], [0, 1])
    assert fit(frames, (28, 42)) is frames


def test_fitting_keeps_depth_values_and_poses():
    rooms = Rooms("val", height=96, width=128, num_frames=2, num_rooms=1)
    frames = rooms.read(rooms.sequences[0], [0, 1])
    fitted = fit(frames, (42, 70))
    assert np.isin(fitted.depth, frames.depth).all()
    assert fitted.extrinsics is frames.extrinsics and fitted.metric


def test_sizes_and_principal_points_out_of_range_are_refused():
    frames = random_frames(np.random.default_rng(0), 40, 60)
    with pytest.raises(ValueError, match="multiples of 14"):
        fit(frames, (40, 60))
    frames.intrinsics[0, 0, 2] = 70
    with pytest.raises(ValueError, match="principal point"):
        fit(frames, (28, 42))


def test_depth_returns_to_the_original_size():
    _, transform = preprocess(np.zeros((1, 56, 84, 3), np.uint8), longer_edge=42)
    depth = np.arange(28 * 42, dtype=np.float32).reshape(1, 28, 42)
    assert np.array_equal(transform.depth_to_original(depth), depth.repeat(2, 1).repeat(2, 2))
    with pytest.raises(ValueError, match="28, 42"):
        transform.depth_to_original(depth[:, :, :41])


def test_fitting_resamples_as_preprocessing_does(golden_dir: Path):
    source = np.load(golden_dir / "vggt_preprocess.npz", allow_pickle=False)["src"]
    # With this principal point the crop is the whole picture.
    matrix = np.array([[100, 0, 56.5 / 0.7 - 0.5], [0, 100, 42.5 / 0.7 - 0.5], [0, 0, 1]], np.float32)
    depth, pose = np.ones((1, *source.shape[:2]), np.float32), np.eye(4, dtype=np.float32)[None]
    frames = Frames(source[None], depth, matrix[None], pose, True)
    fitted = fit(frames, (84, 112))
    expected, _ = preprocess([source], longer_edge=112)
    assert np.abs(fitted.images[0] / 255.0 - expected[0]).max() < 1.01 / 255


@settings(deadline=None)
@given(height=st.integers(20, 2000), width=st.integers(20, 2000))
def test_the_nearest_size_has_the_nearest_aspect_ratio(height: int, width: int):
    sizes = [(392, 518), (294, 518), (154, 518), (518, 392), (518, 266)]
    chosen = nearest_size((height, width), sizes)
    loss = [max(w / width / (h / height), h / height / (w / width)) for h, w in sizes]
    assert sizes[int(np.argmin(loss))] == chosen
    if width >= 1.2 * height:
        assert chosen[1] > chosen[0], "landscape pictures stay landscape"
    if height >= 1.2 * width:
        assert chosen[0] > chosen[1]
    assert nearest_size((width, height), [(w, h) for h, w in sizes]) == chosen[::-1]
