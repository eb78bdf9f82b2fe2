"""A camera moving through the analytic room, for tests of readers; shares no code with the package."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from analytic_room import camera_to_world, disagreement, pinhole, view

SIZE = (48, 64)
FOCAL, CENTRE = 55.0, (30.75, 24.5)
INTRINSICS = pinhole(SIZE, FOCAL, CENTRE)


@dataclass(frozen=True)
class View:
    """Picture [H, W, 3] uint8 RGB, z-depth [H, W] float64 in metres, pose [4, 4] camera-to-world."""

    image: np.ndarray
    depth: np.ndarray
    camera_to_world: np.ndarray

    @property
    def extrinsics(self) -> np.ndarray:
        return np.linalg.inv(self.camera_to_world)


def room_video(count: int = 4, *, intrinsics: np.ndarray = INTRINSICS, size: tuple[int, int] = SIZE) -> list[View]:
    poses = [camera_to_world(index) for index in range(count)]
    return [View(*view(pose, intrinsics, size), pose) for pose in poses]


def write_image(path: Path, image: np.ndarray) -> None:
    """8-bit RGB, or 16-bit depth as it is; JPEG nearly without loss."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = image[..., ::-1] if image.ndim == 3 else image
    options = [cv2.IMWRITE_JPEG_QUALITY, 100] if path.suffix == ".jpg" else []
    assert cv2.imwrite(str(path), stored, options)


def relative_poses(extrinsics: np.ndarray) -> np.ndarray:
    """World-to-camera matrices [T, 4, 4] in the frame of the first camera: free of the choice of world."""
    extrinsics = np.asarray(extrinsics, np.float64)
    return extrinsics @ np.linalg.inv(extrinsics[0])


def check_video(
    frames,
    expected: Sequence[View],
    *,
    depth_error: float,
    colour_error: float = 0.0,
    intrinsics: np.ndarray = INTRINSICS,
    same_world: bool = True,
) -> None:
    """Asserts that the package's `Frames` are the `expected` views, and that their frames agree with each other."""
    images = np.stack([each.image for each in expected]).astype(np.float64)
    extrinsics = np.stack([each.extrinsics for each in expected])
    assert frames.images.dtype == np.uint8 and frames.images.shape == images.shape
    assert np.abs(frames.images - images).mean() <= colour_error
    assert frames.depth.dtype == frames.intrinsics.dtype == frames.extrinsics.dtype == np.float32
    np.testing.assert_allclose(frames.depth, np.stack([each.depth for each in expected]), atol=depth_error, rtol=1e-6)
    np.testing.assert_allclose(frames.intrinsics, np.broadcast_to(intrinsics, (len(expected), 3, 3)), rtol=1e-6)
    if same_world:
        np.testing.assert_allclose(frames.extrinsics, extrinsics, atol=1e-5)
    np.testing.assert_allclose(relative_poses(frames.extrinsics), relative_poses(extrinsics), atol=1e-5)
    assert (np.linalg.det(frames.extrinsics[:, :3, :3]) > 0).all()
    for first, second in ((0, 1), (len(expected) - 1, 0)):
        # Half a pixel of rounding on slanted walls; a wrong axis or unit gives tens of percent.
        error, share = disagreement(frames, first, second)
        assert error < 0.01 and share > 0.5
