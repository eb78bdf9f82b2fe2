"""Cameras: rigid transforms, projection and its inverse, in numpy and in JAX."""

import jax
import numpy as np
import pytest

from logvggt_jax.geometry import (
    as_matrix,
    camera_centres,
    compose,
    invert,
    project,
    quaternion_to_matrix,
    relative_to_first,
    transform_points,
    unproject,
    unproject_pixels,
)

HEIGHT, WIDTH = 6, 8


def poses(*shape: int) -> np.ndarray:
    generator = np.random.default_rng(0)
    matrices = np.tile(np.eye(4), (*shape, 1, 1))
    matrices[..., :3, :3] = quaternion_to_matrix(generator.normal(size=(*shape, 4)))
    matrices[..., :3, 3] = generator.normal(size=(*shape, 3))
    return matrices


def intrinsics(*shape: int) -> np.ndarray:
    matrix = np.array([[7.0, 0.0, WIDTH / 2], [0.0, 9.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return np.tile(matrix, (*shape, 1, 1))


@pytest.mark.parametrize("rows", [3, 4])
def test_compose_and_invert_are_those_of_matrices(rows: int) -> None:
    a, b = poses(2, 5)[:, :, :, :], poses(2, 5)[::-1]
    np.testing.assert_allclose(compose(a[..., :rows, :], b[..., :rows, :]), a @ b, atol=1e-12)
    np.testing.assert_allclose(invert(a[..., :rows, :]), np.linalg.inv(a), atol=1e-12)
    np.testing.assert_array_equal(as_matrix(a[..., :rows, :]), a)


def test_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"must end in \[3, 4\] or \[4, 4\], got shape \(3, 3\)"):
        as_matrix(np.eye(3))


def test_centres_map_to_the_cameras_origin() -> None:
    extrinsics = poses(5)
    np.testing.assert_allclose(transform_points(extrinsics, camera_centres(extrinsics)[:, None]), 0.0, atol=1e-12)


def test_relative_to_first_keeps_relative_poses() -> None:
    extrinsics = poses(2, 5)
    relative = relative_to_first(extrinsics)
    np.testing.assert_allclose(relative[:, 0], np.tile(np.eye(4), (2, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(
        relative[:, 3] @ np.linalg.inv(relative[:, 1]), extrinsics[:, 3] @ np.linalg.inv(extrinsics[:, 1]), atol=1e-12
    )


@pytest.mark.parametrize("compiled", [False, True], ids=["numpy", "jax"])
@pytest.mark.parametrize("world", [False, True])
def test_every_pixel_comes_back_from_space(compiled: bool, world: bool) -> None:
    def there_and_back(depth, calibration, *cameras):
        points = unproject(depth, calibration, *cameras)
        assert isinstance(points, jax.Array) == compiled, "answers in kind"
        return project(points.reshape(2, 3, -1, 3), calibration, *cameras)

    depth = np.random.default_rng(1).uniform(1, 3, (2, 3, HEIGHT, WIDTH)).astype(np.float32)
    cameras = [intrinsics(2, 3).astype(np.float32), *([poses(2, 3).astype(np.float32)] if world else [])]
    pixels, z = (jax.jit(there_and_back) if compiled else there_and_back)(depth, *cameras)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    expected = np.broadcast_to(np.stack([u, v], axis=-1).reshape(-1, 2), pixels.shape)
    np.testing.assert_allclose(pixels, expected, atol=2e-4)
    np.testing.assert_allclose(z, depth.reshape(2, 3, -1), rtol=1e-5)


def test_pixel_centres_are_integers_and_depth_is_z() -> None:
    points = unproject(np.full((HEIGHT, WIDTH), 2.0), intrinsics())
    np.testing.assert_allclose(points[HEIGHT // 2, WIDTH // 2], [0.0, 0.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(points[0, 0], [2.0 * (0 - WIDTH / 2) / 7, 2.0 * (0 - HEIGHT / 2) / 9, 2.0])


def test_a_point_in_the_cameras_plane_has_no_pixel() -> None:
    pixels, depth = project(np.array([[1.0, 1.0, 0.0]]), intrinsics())
    assert depth[0] == 0.0 and np.isnan(pixels).all()


def test_chosen_pixels_have_the_points_that_all_of_them_have() -> None:
    depth = np.random.default_rng(1).uniform(1, 3, (3, HEIGHT, WIDTH)).astype(np.float32)
    everything = unproject(depth.astype(np.float64), intrinsics(3), poses(3)).reshape(-1, 3)
    # Frame 1 has none.
    chosen = np.array([0, 17, HEIGHT * WIDTH - 1, 2 * HEIGHT * WIDTH, 3 * HEIGHT * WIDTH - 1])
    np.testing.assert_allclose(unproject_pixels(depth, intrinsics(3), poses(3), chosen), everything[chosen])
