"""Pose encodings: what is encoded comes back, and what each number means."""

import math

import numpy as np
import pytest

from logvggt_jax.geometry import decode_poses, encode_poses, quaternion_to_matrix

SIZE = (56, 70)


def cameras(count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    extrinsics = np.zeros((count, 3, 4))
    extrinsics[:, :, :3] = quaternion_to_matrix(generator.normal(size=(count, 4)))
    extrinsics[:, :, 3] = generator.normal(size=(count, 3))
    intrinsics = np.zeros((count, 3, 3))
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = generator.uniform(30, 90, (2, count))
    intrinsics[:, 0, 2], intrinsics[:, 1, 2], intrinsics[:, 2, 2] = SIZE[1] / 2, SIZE[0] / 2, 1.0
    return extrinsics, intrinsics


def test_there_and_back() -> None:
    extrinsics, intrinsics = cameras()
    found = decode_poses(encode_poses(extrinsics, intrinsics, SIZE), SIZE)
    np.testing.assert_allclose(found[0], extrinsics, atol=1e-12)
    np.testing.assert_allclose(found[1], intrinsics, atol=1e-10)


def test_numbers_in_their_order() -> None:
    extrinsics = np.concatenate([np.eye(3), [[1.0], [2.0], [3.0]]], axis=1)
    intrinsics = np.array([[35.0, 0.0, 35.0], [0.0, 28.0 / math.tan(0.4), 28.0], [0.0, 0.0, 1.0]])
    encoding = encode_poses(extrinsics, intrinsics, SIZE)
    np.testing.assert_allclose(encoding, [1, 2, 3, 0, 0, 0, 1, 0.8, math.pi / 2], atol=1e-12)


def test_the_principal_point_is_the_middle_and_scales_with_the_image() -> None:
    extrinsics, intrinsics = cameras(1)
    encoding = encode_poses(extrinsics, intrinsics, SIZE)
    _, doubled = decode_poses(encoding, (2 * SIZE[0], 2 * SIZE[1]))
    np.testing.assert_allclose(doubled[:, :2], 2.0 * intrinsics[:, :2], rtol=1e-12)


@pytest.mark.parametrize("length", [0.1, 1.0, 5.0])
def test_quaternions_of_any_length_are_accepted(length: float) -> None:
    encoding = np.array([0.0, 0.0, 0.0, 0.1, -0.2, 0.3, 0.9, 1.0, 1.2])
    longer = encoding.copy()
    longer[3:7] *= length
    np.testing.assert_allclose(decode_poses(longer, SIZE)[0], decode_poses(encoding, SIZE)[0], atol=1e-12)
