"""How points, cameras and the ground are drawn and looked at with viser, in every window alike."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from logvggt_jax.geometry import camera_centres, matrix_to_quaternion
from logvggt_jax.reconstruction.viewer.opening_view import View

# The line through all cameras, a camera, and the one that is looked at.
PATH, FRUSTUM, PRESENT = (230, 80, 50), (120, 150, 200), (255, 190, 40)
# Cameras that are drawn of a finished sequence, evenly over it.
MOST_FRUSTA = 40
# Pixels: pictures in the scene, and beside it.
_THUMBNAIL, _PICTURE = 96, 320
_LINES: dict[str, Any] = {"thickness": 1.5, "thickness_units": "screen"}
# The size of cameras by that of the scene, at most and at least; between, as far as one is from the next.
_LARGEST, _SMALLEST = 1 / 80, 1 / 200


def draw_points(server: Any, points: np.ndarray, colours: np.ndarray, size: float) -> Any:
    """The cloud, points [n, 3] with colours [n, 3] uint8, in place of an earlier one."""
    return server.scene.add_point_cloud(
        "/points",
        points,
        colours,
        point_size=size,
        point_shape="circle",
        point_shading="flat",
        precision="float32",  # of half precision a scene shows the steps
    )


def draw_path(server: Any, centres: np.ndarray) -> Any:
    """The line through camera centres [n, 3], n > 1."""
    segments = np.stack([centres[:-1], centres[1:]], axis=1)
    return server.scene.add_line_segments("/path", segments, colors=PATH, **_LINES)


def draw_camera(
    server: Any,
    name: str,
    extrinsics: np.ndarray,
    intrinsics: np.ndarray,
    image_size: tuple[int, int],
    *,
    size: float,
    colour: tuple[int, int, int] = FRUSTUM,
    picture: np.ndarray | None = None,
) -> Any:
    """A camera's frustum.

    Args:
      server: viser's.
      name: of the node; an earlier one of this name goes.
      extrinsics: [3, 4] world-to-camera.
      intrinsics: [3, 3] in pixels of images of `image_size`.
      image_size: (H, W).
      size: from the centre to the picture, in the world's unit.
      colour: of the lines.
      picture: [h, w, 3] uint8, shown small; None for none.
    """
    x, y, z, w = matrix_to_quaternion(extrinsics[None, :3, :3].swapaxes(-1, -2))[0]
    return server.scene.add_camera_frustum(
        name,
        fov=2 * float(np.arctan(image_size[0] / 2 / intrinsics[1, 1])),
        aspect=image_size[1] * float(intrinsics[1, 1] / intrinsics[0, 0]) / image_size[0],
        scale=size,
        color=colour,
        **_LINES,
        image=None if picture is None else shrunk(picture, _THUMBNAIL),
        format="jpeg",
        wxyz=(w, x, y, z),
        position=tuple(camera_centres(extrinsics[None])[0]),
    )


def camera_size(centres: np.ndarray, span: float) -> float:
    """How large cameras at `centres` [n, 3] are drawn in a scene of this span: apart from one another, but visible."""
    apart = float(np.median(np.linalg.norm(np.diff(centres, axis=0), axis=1))) if len(centres) > 1 else 0.0
    return float(np.clip(apart, span * _SMALLEST, span * _LARGEST))


def look_from(client: Any, view: View) -> None:
    """Takes one browser's camera there."""
    with client.atomic():
        client.camera.up_direction = tuple(view.up)
        client.camera.position = tuple(view.position)
        client.camera.look_at = tuple(view.target)
        client.camera.fov = view.field_of_view


def set_ground(server: Any, *, dark: bool) -> None:
    """The page and the ground of the scene, dark or light."""
    server.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
    server.scene.set_background_image(np.full((1, 1, 3), 18 if dark else 250, np.uint8), format="png")


def shrunk(picture: np.ndarray, width: int = _PICTURE) -> np.ndarray:
    """The picture [h, w, 3] at this width."""
    height = max(1, round(picture.shape[0] * width / picture.shape[1]))
    smaller = width < picture.shape[1]
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_NEAREST)
