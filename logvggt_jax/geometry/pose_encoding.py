"""VGGT's pose encoding: translation (3), quaternion x y z w (4), vertical and horizontal field of view (2)."""

from typing import Any

from logvggt_jax.geometry.rotations import matrix_to_quaternion, namespace, quaternion_to_matrix


def encode_poses(extrinsics: Any, intrinsics: Any, image_size: tuple[int, int]) -> Any:
    """Pose encodings [..., 9] of world-to-camera `extrinsics` [..., 3|4, 4] and `intrinsics` [..., 3, 3].

    `image_size` is (H, W) in the intrinsics' pixels. The principal point is not encoded: decoding puts it at
    (W/2, H/2).
    """
    xp = namespace(extrinsics)
    height, width = image_size
    fov_h = 2.0 * xp.arctan((height / 2.0) / intrinsics[..., 1, 1])
    fov_w = 2.0 * xp.arctan((width / 2.0) / intrinsics[..., 0, 0])
    quaternion = matrix_to_quaternion(extrinsics[..., :3, :3])
    fields = xp.stack([fov_h, fov_w], axis=-1)
    return xp.concatenate([extrinsics[..., :3, 3], quaternion, fields], axis=-1)


def decode_poses(pose_encoding: Any, image_size: tuple[int, int]) -> tuple[Any, Any]:
    """World-to-camera extrinsics [..., 3, 4] and intrinsics [..., 3, 3] (pixels) of encodings [..., 9].

    `image_size` is (H, W) of the model's input; the principal point is (W/2, H/2). Quaternions of any non-zero
    length are accepted.
    """
    xp = namespace(pose_encoding)
    height, width = image_size
    rotation = quaternion_to_matrix(pose_encoding[..., 3:7])
    extrinsics = xp.concatenate([rotation, pose_encoding[..., :3, None]], axis=-1)
    fy = (height / 2.0) / xp.tan(pose_encoding[..., 7] / 2.0)
    fx = (width / 2.0) / xp.tan(pose_encoding[..., 8] / 2.0)
    zero, one = xp.zeros_like(fx), xp.ones_like(fx)
    rows = [[fx, zero, one * (width / 2.0)], [zero, fy, one * (height / 2.0)], [zero, zero, one]]
    intrinsics = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
    return extrinsics, intrinsics
