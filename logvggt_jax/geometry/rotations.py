"""Rotations: quaternions (x, y, z, w), matrices, angles."""

from typing import Any


def namespace(array: Any) -> Any:
    """The array API namespace (numpy or jax.numpy) of an array."""
    return array.__array_namespace__()


def quaternion_to_matrix(quaternion: Any) -> Any:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] in the order x, y, z, w.

    Any non-zero length is accepted: the factor 2/|q|^2 normalises.
    """
    xp = namespace(quaternion)
    x, y, z, w = (quaternion[..., i] for i in range(4))
    s = 2.0 / (quaternion * quaternion).sum(-1)
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quaternion(matrix: Any) -> Any:
    """Quaternions [..., 4] (x, y, z, w) of rotation matrices [..., 3, 3], with w >= 0.

    Of the four algebraically equal candidates the one with the largest divisor is taken, which keeps half turns
    accurate. The square root has zero slope at zero, so that gradients stay finite.
    """
    xp = namespace(matrix)
    m = [[matrix[..., i, j] for j in range(3)] for i in range(3)]
    squares = xp.stack(
        [
            1 + m[0][0] + m[1][1] + m[2][2],
            1 + m[0][0] - m[1][1] - m[2][2],
            1 - m[0][0] + m[1][1] - m[2][2],
            1 - m[0][0] - m[1][1] + m[2][2],
        ],
        axis=-1,
    )
    positive = squares > 0
    roots = xp.where(positive, xp.sqrt(xp.where(positive, squares, 1.0)), 0.0)
    w2, x2, y2, z2 = (roots[..., i] ** 2 for i in range(4))
    candidates = xp.stack(
        [
            xp.stack([m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1], w2], axis=-1),
            xp.stack([x2, m[1][0] + m[0][1], m[0][2] + m[2][0], m[2][1] - m[1][2]], axis=-1),
            xp.stack([m[1][0] + m[0][1], y2, m[1][2] + m[2][1], m[0][2] - m[2][0]], axis=-1),
            xp.stack([m[2][0] + m[0][2], m[2][1] + m[1][2], z2, m[1][0] - m[0][1]], axis=-1),
        ],
        axis=-2,
    )
    candidates = candidates / (2.0 * xp.maximum(roots, 0.1)[..., None])
    best = xp.argmax(roots, axis=-1)[..., None, None]
    quaternion = xp.take_along_axis(candidates, best, axis=-2)[..., 0, :]
    return xp.where(quaternion[..., 3:] < 0, -quaternion, quaternion)


def rotation_angle(rotation_a: Any, rotation_b: Any) -> Any:
    """Angle in radians, [...], between rotation matrices [..., 3, 3].

    Uses the arctangent of the quaternion's parts, which keeps small angles accurate where the arccosine of the
    trace does not.
    """
    xp = namespace(rotation_a)
    relative = (rotation_a[..., :, :, None] * rotation_b[..., :, None, :]).sum(-3)
    quaternion = matrix_to_quaternion(relative)
    squared = (quaternion[..., :3] ** 2).sum(-1)
    positive = squared > 0
    sine = xp.where(positive, xp.sqrt(xp.where(positive, squared, 1.0)), 0.0)
    return 2.0 * xp.arctan2(sine, quaternion[..., 3])


def nearest_rotation(matrix: Any) -> Any:
    """The rotation [..., 3, 3] nearest to a matrix [..., 3, 3] in the Frobenius norm (determinant +1)."""
    xp = namespace(matrix)
    u, _, vt = xp.linalg.svd(matrix)
    determinant = xp.sign(xp.linalg.det(u) * xp.linalg.det(vt))
    signs = xp.stack([xp.ones_like(determinant), xp.ones_like(determinant), determinant], axis=-1)
    return ((u * signs[..., None, :])[..., :, :, None] * vt[..., None, :, :]).sum(-2)


def is_rotation(matrix: Any) -> Any:
    """Whether matrices [..., 3, 3] are rotations, to 1e-3 in every entry of R^T R; bool [...]."""
    xp = namespace(matrix)
    gram = (matrix[..., :, :, None] * matrix[..., :, None, :]).sum(-3)
    orthogonal = (xp.abs(gram - xp.eye(3)) <= 1e-3).all((-2, -1))
    turned = xp.linalg.cross(matrix[..., 0, :], matrix[..., 1, :])
    return orthogonal & ((turned * matrix[..., 2, :]).sum(-1) > 0)
