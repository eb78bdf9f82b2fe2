"""Numbers from calibration and pose files, checked: intrinsics in pixels, world-to-camera OpenCV extrinsics."""

from pathlib import Path

import numpy as np

from logvggt_jax.data.errors import AbsurdIntrinsics, BadPose
from logvggt_jax.errors import InputError
from logvggt_jax.geometry import invert, nearest_rotation, quaternion_to_matrix

# Camera axes x right, y up, z back to x right, y down, z forward, and the reverse; multiplied from the right onto
# camera-to-world, from the left onto world-to-camera matrices.
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
_ROTATION_TOLERANCE = 0.01
# Focal length over the longer edge: a full circle's fisheye is below, a telescope above.
_FOCAL_RANGE = (0.1, 50.0)
# Cameras of these sets have square pixels; 4:3 for 3:4 or 16:9 for 4:3 is a factor of 1.3 or more.
_PIXEL_ASPECT = 1.2


def numbers(text: str, where: str | Path, *, count: int | None = None) -> np.ndarray:
    """All numbers of a text, float64 [n]; nan and inf are numbers.

    Raises InputError naming `where` for other words, or another number than `count`.
    """
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError as error:
        raise InputError(f"{where}: expected numbers: {error}; fetch the file again") from error
    if count is not None and len(values) != count:
        raise InputError(f"{where}: expected {count} numbers, got {len(values)}: fetch the file again")
    return values


def whole_number(value: float, where: str | Path) -> int:
    """A number of `numbers` as an integer; InputError naming `where` for one that is none."""
    if not float(value).is_integer():
        raise InputError(f"{where}: expected a whole number, got {value:g}: fetch the file again")
    return int(value)


def pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Intrinsics [3, 3] float64, pixels with centres at integers."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def scaled(intrinsics: np.ndarray, scale_x: float, scale_y: float) -> np.ndarray:
    """Intrinsics [3, 3] of a picture resized by these factors: f' = s f, c' = (c + 0.5) s - 0.5."""
    shift = np.array([[scale_x, 0, 0.5 * scale_x - 0.5], [0, scale_y, 0.5 * scale_y - 0.5], [0, 0, 1]])
    with np.errstate(invalid="ignore"):  # what is not finite is refused when it is used
        return shift @ intrinsics


def world_to_camera(pose: np.ndarray, where: str | Path, *, stored: str) -> np.ndarray | None:
    """World-to-camera [4, 4] float64 of a stored rigid transform, its rotation projected onto SO(3).

    The `pose` [3, 4] or [4, 4], OpenCV camera axes, is `stored` as `camera_to_world` or `world_to_camera`; None where
    it is not finite (lost tracking). Raises InputError naming `where` (file and line): not a rotation to 0.01,
    mirrored, or a last row other than 0 0 0 1.
    """
    if not np.isfinite(pose).all():
        return None
    stored_rotation = np.asarray(pose[:3, :3], np.float64)
    # Numbers of another magnitude would overflow in the decomposition.
    rotation = nearest_rotation(stored_rotation) if np.abs(stored_rotation).max() < 2 else np.zeros((3, 3))
    last_row_fits = len(pose) == 3 or np.abs(pose[3] - [0, 0, 0, 1]).max() < 1e-3
    if not last_row_fits or np.abs(stored_rotation - rotation).max() > _ROTATION_TOLERANCE:
        raise BadPose(
            f"{where}: not a rigid transform (a rotation to {_ROTATION_TOLERANCE} and the last row 0 0 0 1 are "
            "expected): fetch the file again"
        )
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = rotation, pose[:3, 3]
    if stored == "world_to_camera":
        return rigid
    if stored == "camera_to_world":
        return invert(rigid)
    raise ValueError(f"stored must be camera_to_world or world_to_camera, got {stored!r}")


def pose_from_quaternion(
    quaternion: np.ndarray, position: np.ndarray, where: str | Path, *, stored: str
) -> np.ndarray | None:
    """World-to-camera [4, 4] float64 of a pose that is `stored` as in `world_to_camera`: `quaternion` x y z w, [4], and
    `position` [3]; None where it is not finite.

    Raises BadPose naming `where` for a quaternion whose length is not 1 to 0.01.
    """
    if not (np.isfinite(quaternion).all() and np.isfinite(position).all()):
        return None
    # Numbers of another magnitude would overflow in the length.
    if np.abs(quaternion).max() > 2 or abs(np.linalg.norm(quaternion) - 1) > _ROTATION_TOLERANCE:
        raise BadPose(f"{where}: expected a unit quaternion, got {quaternion} (x y z w): fetch the file again")
    pose = np.concatenate([quaternion_to_matrix(quaternion), position[:, None]], axis=1)
    return world_to_camera(pose, where, stored=stored)


def check_intrinsics(intrinsics: np.ndarray, size: tuple[int, int], picture: Path, calibration: Path | None) -> None:
    """Raises InputError unless intrinsics [3, 3] can belong to `picture`, which has `size` (H, W).

    It names the file `calibration` that they are from, and the picture; only that where the set's cameras are constant.

    Expected: finite, focal lengths of 0.1 to 50 times the longer edge, a principal point within half a picture of
    the picture, no more than a little skew, the last row 0 0 1.
    """
    height, width = size
    longer = max(size)
    low, high = _FOCAL_RANGE[0] * longer, _FOCAL_RANGE[1] * longer
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    plausible = (
        np.isfinite(intrinsics).all()
        and low <= fx <= high
        and low <= fy <= high
        and -width / 2 <= cx <= 1.5 * width
        and -height / 2 <= cy <= 1.5 * height
        and abs(intrinsics[0, 1]) < 0.1 * fx
        and np.abs(intrinsics[1:, 0]).max() < 1e-6
        and np.abs(intrinsics[2] - [0, 0, 1]).max() < 1e-6
    )
    if not plausible:
        raise AbsurdIntrinsics(
            f"{calibration or picture}: intrinsics fx={fx:g} fy={fy:g} cx={cx:g} cy={cy:g} cannot belong to a picture "
            f"of {width} x {height}, as {picture.name} is: fetch the calibration again"
        )


def relative(intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics [3, 3] in pixels of a picture of `size` (H, W) as those of a picture of one pixel."""
    return scaled(intrinsics, 1 / size[1], 1 / size[0])


def in_pixels(
    intrinsics: np.ndarray, size: tuple[int, int], picture: Path, calibration: Path | None = None
) -> np.ndarray:
    """Intrinsics [3, 3] of a picture of one pixel as those of `picture`, which has `size` (H, W).

    Raises InputError naming `picture`, and the file `calibration` that they are from, where its pixels would be far
    from square: it was turned or cropped.
    """
    matrix = scaled(intrinsics, size[1], size[0])
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        aspect = matrix[0, 0] / matrix[1, 1]
    if not 1 / _PIXEL_ASPECT < aspect < _PIXEL_ASPECT:
        raise InputError(
            f"{picture}: a picture of {size[1]} x {size[0]} does not have the shape of its calibration"
            f"{f' {calibration}' if calibration else ''} (fx / fy would be {aspect:.3g}, expected about 1): fetch both "
            "again"
        )
    return matrix
