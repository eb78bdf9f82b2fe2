"""What tests of readers on the analytic room share: its views from a moving camera, and the comparison with them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from analytic_room import camera_to_world, disagreement, pinhole, view

from logvggt_jax.data.dataset import check_frames
from logvggt_jax.frames import Frames

SIZE = (48, 64)
FOCAL, CENTRE = 55.0, (30.75, 24.5)
INTRINSICS = pinhole(SIZE, FOCAL, CENTRE)


@dataclass(frozen=True)
class RoomView:
    """Camera-to-world [4, 4], intrinsics [3, 3], picture [H, W, 3] uint8 RGB, z-depth [H, W] float64 metres."""

    pose: np.ndarray
    intrinsics: np.ndarray
    picture: np.ndarray
    depth: np.ndarray

    @property
    def extrinsics(self) -> np.ndarray:
        return np.linalg.inv(self.pose) if np.isfinite(self.pose).all() else self.pose


def room_views(
    count: int, intrinsics: np.ndarray = INTRINSICS, size: tuple[int, int] = SIZE, *, shift: float = 0.0
) -> list[RoomView]:
    """Views of the first `count` cameras of the room's path, `shift` metres to the right of it."""
    poses = [camera_to_world(index) for index in range(count)]
    for pose in poses:
        pose[:3, 3] += shift * pose[:3, 0]
    return [RoomView(pose, intrinsics, *view(pose, intrinsics, size)) for pose in poses]


def frames_of(views: Sequence[RoomView]) -> Frames:
    return Frames(
        images=np.stack([each.picture for each in views]),
        depth=np.stack([each.depth for each in views]).astype(np.float32),
        intrinsics=np.stack([each.intrinsics for each in views]).astype(np.float32),
        extrinsics=np.stack([each.extrinsics for each in views]).astype(np.float32),
        metric=True,
    )


def pinhole_row(each: RoomView) -> list[float]:
    """fx, fy, cx, cy."""
    return [float(each.intrinsics[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2))]


def write_image(path: Path, image: np.ndarray) -> None:
    """8-bit RGB, or 8- or 16-bit grey as it is; JPEG nearly without loss."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = image[..., ::-1] if image.ndim == 3 else image
    options = [cv2.IMWRITE_JPEG_QUALITY, 100] if path.suffix == ".jpg" else []
    assert cv2.imwrite(str(path), stored, options)


def millimetres(depth: np.ndarray) -> np.ndarray:
    return np.rint(depth * 1000).astype(np.uint16)


def check_views(
    frames: Frames,
    views: Sequence[RoomView],
    *,
    picture_error: float,
    depth_error: float,
    overlap: float = 0.4,
    poses: bool = True,
) -> None:
    """Asserts that `frames` are `views`: pictures to a mean of `picture_error` levels, depth to `depth_error` metres,
    calibration to float32; and where there are `poses` that they are those, relative to the first frame, and that
    every frame's depth, carried into the next, agrees with what is there over a share of at least `overlap`."""
    check_frames(frames, "the analytic room", poses=poses)
    assert len(frames.images) == len(views)
    for i, expected in enumerate(views):
        assert np.abs(frames.images[i].astype(float) - expected.picture).mean() <= picture_error
        np.testing.assert_allclose(frames.depth[i], expected.depth, atol=depth_error, rtol=1e-6)
        np.testing.assert_allclose(frames.intrinsics[i], expected.intrinsics, rtol=1e-5, atol=1e-5)
    if not poses:
        assert np.isnan(frames.extrinsics).all()
        return
    # Sets have worlds of their own: compared is what does not depend on it.
    relative = [extrinsics @ np.linalg.inv(frames.extrinsics[0]) for extrinsics in frames.extrinsics.astype(float)]
    np.testing.assert_allclose(relative, [each.extrinsics @ views[0].pose for each in views], atol=2e-5)
    for first in range(len(views) - 1):
        for one, other in ((first, first + 1), (first + 1, first)):
            difference, share = disagreement(frames, one, other)
            assert difference < 0.01 and share > overlap, (one, other, difference, share)
