"""The group Sim(3) of similarity transforms as 4 x 4 matrices (numpy, float64): exponential, logarithm, derivatives.

A similarity is [[s R, t], [0, 1]]. A tangent is seven numbers: translation (3), rotation vector in radians (3),
logarithm of the scale (1), in this order. All functions take any leading axes.
"""

from __future__ import annotations

import numpy as np

from logvggt_jax.geometry.rotations import matrix_to_quaternion

# Below this angle (radians) the coefficients of the exponential are those of this angle: what differs is rounding.
_SMALLEST_ANGLE = 1e-4
# Nodes of a quadrature on [0, 1], exact to rounding for the sines and powers that occur up to half a turn.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


def similarity_exp(tangent: np.ndarray) -> np.ndarray:
    """Similarities [..., 4, 4] of tangents [..., 7]."""
    translation, rotation, log_scale = tangent[..., :3], tangent[..., 3:6], tangent[..., 6]
    skew = _skew(rotation)
    angle = np.maximum(np.linalg.norm(rotation, axis=-1), _SMALLEST_ANGLE)
    matrix = np.zeros((*tangent.shape[:-1], 4, 4))
    turn = np.eye(3) + _scaled(np.sin(angle) / angle, skew) + _scaled((1 - np.cos(angle)) / angle**2, skew @ skew)
    matrix[..., :3, :3] = _scaled(np.exp(log_scale), turn)
    matrix[..., :3, 3] = (_translation_part(rotation, log_scale) @ translation[..., None])[..., 0]
    matrix[..., 3, 3] = 1.0
    return matrix


def similarity_log(matrix: np.ndarray) -> np.ndarray:
    """Tangents [..., 7] of similarities [..., 4, 4], the inverse of `similarity_exp` up to half a turn."""
    scale = scale_of(matrix)
    quaternion = matrix_to_quaternion(matrix[..., :3, :3] / scale[..., None, None])
    sine = np.linalg.norm(quaternion[..., :3], axis=-1)
    angle = 2.0 * np.arctan2(sine, quaternion[..., 3])
    rotation = quaternion[..., :3] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0)[..., None]
    log_scale = np.log(scale)
    translation = np.linalg.solve(_translation_part(rotation, log_scale), matrix[..., :3, 3, None])[..., 0]
    return np.concatenate([translation, rotation, log_scale[..., None]], axis=-1)


def scale_of(matrix: np.ndarray) -> np.ndarray:
    """Scales [...] of similarities [..., 4, 4]."""
    return np.cbrt(np.linalg.det(matrix[..., :3, :3]))


def similarity_adjoint(matrix: np.ndarray) -> np.ndarray:
    """[..., 7, 7]: S exp(x) S^-1 = exp(adjoint(S) x)."""
    rotation = matrix[..., :3, :3] / scale_of(matrix)[..., None, None]
    adjoint = np.zeros((*matrix.shape[:-2], 7, 7))
    adjoint[..., :3, :3] = matrix[..., :3, :3]
    adjoint[..., :3, 3:6] = _skew(matrix[..., :3, 3]) @ rotation
    adjoint[..., :3, 6] = -matrix[..., :3, 3]
    adjoint[..., 3:6, 3:6] = rotation
    adjoint[..., 6, 6] = 1.0
    return adjoint


def log_derivative(tangent: np.ndarray) -> np.ndarray:
    """[..., 7, 7], by which log(exp(x) exp(y)) moves with small y.

    It is the inverse of the integral over u in [0, 1] of adjoint(exp(-u x)), which a quadrature gives.
    """
    steps = -0.5 * (_NODES[:, None] + 1.0) * tangent[..., None, :]
    right = (0.5 * _WEIGHTS[:, None, None] * similarity_adjoint(similarity_exp(steps))).sum(-3)
    return np.linalg.inv(right)


def _translation_part(rotation: np.ndarray, log_scale: np.ndarray) -> np.ndarray:
    """[..., 3, 3], the integral over u in [0, 1] of exp(u (log_scale + [rotation]x)).

    With f(z) = (e^z - 1) / z it is f of that matrix, whose eigenvalues are log_scale and log_scale +- i angle.
    """
    skew = _skew(rotation)
    angle = np.maximum(np.linalg.norm(rotation, axis=-1), _SMALLEST_ANGLE)
    complex_one = log_scale + 1j * angle
    along = np.where(log_scale == 0, 1.0, np.expm1(log_scale) / np.where(log_scale == 0, 1.0, log_scale))
    across = np.expm1(complex_one) / complex_one
    return (
        _scaled(along, np.eye(3))
        + _scaled(across.imag / angle, skew)
        + _scaled((along - across.real) / angle**2, skew @ skew)
    )


def _scaled(factors: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    return np.asarray(factors)[..., None, None] * matrices


def _skew(vectors: np.ndarray) -> np.ndarray:
    """[..., 3, 3] of [..., 3]: the product with it is the cross product."""
    x, y, z = (vectors[..., i] for i in range(3))
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape[:-1], 3, 3)
