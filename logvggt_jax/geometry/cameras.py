"""Pinhole cameras: world-to-camera extrinsics (OpenCV axes), intrinsics in pixels, centres at integers."""

from typing import Any

import numpy as np

from logvggt_jax.geometry.rotations import namespace

# Of poses and intrinsics in files: squares of larger entries are infinite in float32, in which points are made.
LARGEST_ENTRY = 1e18


def _product(a: Any, b: Any) -> Any:
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def as_matrix(pose: Any) -> Any:
    """[..., 3, 4] or [..., 4, 4] rigid transforms as [..., 4, 4]."""
    if pose.shape[-2:] == (4, 4):
        return pose
    if pose.shape[-2:] != (3, 4):
        raise ValueError(f"poses must end in [3, 4] or [4, 4], got shape {pose.shape}")
    xp = namespace(pose)
    last = xp.zeros_like(pose[..., :1, :]) + xp.asarray([0.0, 0.0, 0.0, 1.0], dtype=pose.dtype)
    return xp.concatenate([pose, last], axis=-2)


def compose(a_from_b: Any, b_from_c: Any) -> Any:
    """a_from_c, [..., 4, 4], of two rigid transforms [..., 3|4, 4]."""
    return _product(as_matrix(a_from_b), as_matrix(b_from_c))


def invert(pose: Any) -> Any:
    """Inverse [..., 4, 4] of rigid transforms [..., 3|4, 4] (rotation transposed, no solve)."""
    xp = namespace(pose)
    rotation = xp.swapaxes(pose[..., :3, :3], -1, -2)
    translation = -(rotation * pose[..., None, :3, 3]).sum(-1)
    return as_matrix(xp.concatenate([rotation, translation[..., None]], axis=-1))


def camera_centres(extrinsics: Any) -> Any:
    """Camera positions in the world, [..., 3], of world-to-camera matrices [..., 3|4, 4]."""
    return -(extrinsics[..., :3, :3] * extrinsics[..., :3, 3, None]).sum(-2)


def relative_to_first(extrinsics: Any) -> Any:
    """World-to-camera matrices [..., T, 4, 4] re-expressed so that camera 0 of axis -3 is the identity."""
    return compose(extrinsics, invert(extrinsics[..., :1, :, :]))


def transform_points(pose: Any, points: Any) -> Any:
    """R x + t for poses [..., 3|4, 4] and points [..., N, 3]."""
    rotated = (pose[..., None, :3, :3] * points[..., None, :]).sum(-1)
    return rotated + pose[..., None, :3, 3]


def unproject(depth: Any, intrinsics: Any, extrinsics: Any | None = None) -> Any:
    """Points [..., H, W, 3] of every pixel of z-depth maps [..., H, W].

    `intrinsics` [..., 3, 3] in pixels. With world-to-camera `extrinsics` [..., 3|4, 4] the points are in the
    world, without in the camera. Source: VGGT, pixel centres at integer coordinates.
    """
    xp = namespace(depth)
    height, width = depth.shape[-2:]
    u = xp.arange(width, dtype=depth.dtype)
    v = xp.arange(height, dtype=depth.dtype)[:, None]
    fx, fy = intrinsics[..., 0, 0, None, None], intrinsics[..., 1, 1, None, None]
    cx, cy = intrinsics[..., 0, 2, None, None], intrinsics[..., 1, 2, None, None]
    points = xp.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], axis=-1)
    if extrinsics is None:
        return points
    flat = points.reshape((*points.shape[:-3], height * width, 3))
    return transform_points(invert(extrinsics), flat).reshape(points.shape)


def unproject_pixels(
    depth: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray, indices: np.ndarray
) -> np.ndarray:
    """World points [N, 3] float64 of some pixels of a clip (numpy), as `unproject` gives them for all.

    Z-depth is [T, H, W] and may be a memory map, of which one frame at a time is read; intrinsics [T, 3, 3] are in
    pixels, extrinsics [T, 3|4, 4] world-to-camera; `indices` [N] are sorted and flat in [T, H, W].
    """
    height, width = depth.shape[1:]
    borders = np.searchsorted(indices, np.arange(len(depth) + 1) * height * width)
    points = np.empty((len(indices), 3))
    for t in range(len(depth)):
        chosen = slice(borders[t], borders[t + 1])
        v, u = np.divmod(indices[chosen] - t * height * width, width)
        pixels, z = np.stack([u, v], axis=-1), depth[t][v, u].astype(np.float64)
        cameras = (np.asarray(each[t], np.float64) for each in (intrinsics, extrinsics))
        points[chosen] = points_at(pixels, z, *cameras)
    return points


def points_at(pixels: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray) -> np.ndarray:
    """World points [N, 3] at pixels [N, 2] (u, v) of one camera (numpy), of z-depth [N]; the inverse of `project`.

    Intrinsics are [3, 3] in pixels, extrinsics [3|4, 4] world-to-camera.
    """
    rays = (pixels - intrinsics[:2, 2]) / intrinsics[(0, 1), (0, 1)]
    in_camera = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) * depth[:, None]
    return transform_points(invert(extrinsics), in_camera)


def project(points: Any, intrinsics: Any, extrinsics: Any | None = None) -> tuple[Any, Any]:
    """Pixels [..., N, 2] (u, v) and z-depth [..., N] of points [..., N, 3].

    Points are in the world if world-to-camera `extrinsics` [..., 3|4, 4] are given, else in the camera. Points
    at or behind the camera (z <= 0) get non-finite or mirrored pixels: check the depth.
    """
    xp = namespace(points)
    if extrinsics is not None:
        points = transform_points(extrinsics, points)
    depth = points[..., 2]
    safe = xp.where(depth == 0, xp.full_like(depth, xp.nan), depth)
    u = intrinsics[..., 0, 0, None] * points[..., 0] / safe + intrinsics[..., 0, 2, None]
    v = intrinsics[..., 1, 1, None] * points[..., 1] / safe + intrinsics[..., 1, 2, None]
    return xp.stack([u, v], axis=-1), depth
