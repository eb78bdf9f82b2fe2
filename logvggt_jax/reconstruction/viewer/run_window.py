"""The page of a run that goes on: what is final is drawn about once a second, at nobody's expense."""

from __future__ import annotations

import threading
import time
import warnings
from collections import deque
from typing import Any

import numpy as np

from logvggt_jax.colours import depth_limits, depth_picture
from logvggt_jax.errors import one_line, printable
from logvggt_jax.frames import evenly_spaced
from logvggt_jax.geometry import camera_centres
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.up_direction import up_direction
from logvggt_jax.reconstruction.viewer.drawing import (
    PRESENT,
    camera_size,
    draw_camera,
    draw_path,
    draw_points,
    look_from,
    set_ground,
    shrunk,
)
from logvggt_jax.reconstruction.viewer.growing_scene import GrowingScene, Scene
from logvggt_jax.reconstruction.viewer.opening_view import View, opening_view, point_spacing, scene_span
from logvggt_jax.reconstruction.viewer.window import Window
from logvggt_jax.reconstruction.watching import LiveResult

# Seconds between two drawings, and at most this share of the time.
_PAUSE, _SHARE = 1.0, 0.1
# Cameras that are drawn besides the newest, evenly over the sequence so far.
_CAMERAS = 16
# What is seen from behind the newest camera: so many times the depth before it, back and up.
_BACK, _ABOVE = 0.6, 0.15


class RunWindow:
    """Draws a run on the page of a viser server; a `Watcher`.

    A thread of its own draws what is new while a browser looks, and rests for at least nine times as long. What is kept
    is bounded, see `GrowingScene`. The page looks over the newest camera's shoulder until its user turns it. The run
    waits for no browser; what goes wrong here is a warning, after which nothing more is drawn.

    Args:
      server: `viser.ViserServer`, which nothing else draws on.
    """

    def __init__(self, server: Any) -> None:
        self.server = server
        self._scene = GrowingScene()
        self._news, self._closing, self._failed = threading.Event(), threading.Event(), False
        # Of each browser that follows, where it was put lately.
        self._followers: dict[int, deque[np.ndarray]] = {}
        self._up: np.ndarray | None = None
        self._drawn: Scene | None = None
        self._spacing = 0.01
        gui = server.gui
        self._status = gui.add_markdown("Waiting for the first frames.")
        self._image = gui.add_image(np.zeros((1, 1, 3), np.uint8), label="newest frame", visible=False)
        self._depth = gui.add_image(np.zeros((1, 1, 3), np.uint8), label="its depth", visible=False)
        self.point_size = gui.add_slider("point size", 0.1, 4.0, 0.1, 1.0)
        self.dark = gui.add_checkbox("dark ground", True)
        follow = gui.add_button("follow the camera")
        overview = gui.add_button("look from the start")
        self.point_size.on_update(lambda _: self._news.set())
        self.dark.on_update(lambda _: set_ground(server, dark=bool(self.dark.value)))
        follow.on_click(lambda event: self._follow(event.client))
        overview.on_click(lambda event: self._look_from_start(event.client))
        server.on_client_connect(self._follow)
        server.on_client_disconnect(lambda client: self._followers.pop(client.client_id, None))
        set_ground(server, dark=True)
        # The first camera's, whose frame is the world. It stays: a browser that learns of another one after it was put
        # somewhere is turned away from there.
        server.scene.set_up_direction("-y")
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def add(self, frame: LiveResult) -> None:
        """See `Watcher`; never waits for a browser and never raises."""
        if not self._failed:
            try:
                self._scene.add(frame)
                self._news.set()
            except Exception as error:
                self._fail(error)

    def place(self, pose_encodings: np.ndarray) -> None:
        """See `Watcher`; likewise."""
        if not self._failed:
            try:
                self._scene.place(pose_encodings)
                self._news.set()
            except Exception as error:
                self._fail(error)

    def show_result(self, result: Reconstruction | None) -> None:
        """The run has ended: its result with all controls, or without one what was drawn last; never raises."""
        try:
            if result is None:
                self._status.content = f"{self._status.content}\n\nThe run has ended."
                return
            self._closing.set()
            self._thread.join()
            self.server.gui.reset()
            self.server.scene.reset()
            Window(self.server, result)
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        self._failed = True
        warnings.warn(f"the viewer shows nothing new, the run goes on: {one_line(error)}", stacklevel=2)

    # In the viewer's thread.

    def _run(self) -> None:
        pause = _PAUSE
        try:
            while not self._closing.wait(pause):
                began = time.monotonic()
                if self._news.is_set() and self.server.get_clients():
                    self._news.clear()
                    if (scene := self._scene.scene()) is not None:
                        self._draw(scene)
                pause = max(_PAUSE, (time.monotonic() - began) / _SHARE)
        except Exception as error:
            if not self._closing.is_set():
                self._fail(error)

    def _draw(self, scene: Scene) -> None:
        server, centres = self.server, camera_centres(scene.extrinsics)
        span = scene_span(scene.points, centres)
        if self._drawn is None:
            self._up = up_direction(scene.extrinsics)
        self._drawn, self._spacing = scene, point_spacing(span, len(scene.points))
        with server.atomic():
            size = float(self.point_size.value) * self._spacing
            draw_points(server, scene.points, scene.colours, size)
            if len(centres) > 1:
                draw_path(server, centres)
            cameras = evenly_spaced(len(centres), _CAMERAS)
            frustum = camera_size(centres[cameras], span)
            for place, index in enumerate(cameras):
                camera = scene.extrinsics[index], scene.intrinsics[index]
                draw_camera(server, f"/cameras/{place:02d}", *camera, scene.image_size, size=frustum)
            newest = scene.extrinsics[-1], scene.intrinsics[-1]
            image = scene.newest.image if scene.newest_is_placed else None
            draw_camera(
                server, "/present", *newest, scene.image_size, size=1.6 * frustum, colour=PRESENT, picture=image
            )
            self._show_newest(scene)
        for client_id, client in server.get_clients().items():
            self._move(client_id, client, span)

    def _show_newest(self, scene: Scene) -> None:
        depth = scene.newest.result.depth
        near, far = depth_limits(depth)
        self._image.image, self._depth.image = (
            shrunk(scene.newest.image),
            shrunk(depth_picture(depth, near=near, far=far)),
        )
        self._image.visible = self._depth.visible = True
        self._image.label = f"newest frame, {printable(scene.newest.name)}"
        self._depth.label = f"its depth, {near:.3g} (yellow) to {far:.3g}"
        self._status.content = f"{scene.num_frames:,} frames are final, {len(scene.points):,} points are shown."

    def _follow(self, client: Any) -> None:
        self._followers[client.client_id] = deque(maxlen=4)
        self._news.set()

    def _look_from_start(self, client: Any) -> None:
        self._followers.pop(client.client_id, None)
        if (scene := self._drawn) is not None:
            view = opening_view(scene.extrinsics, scene.intrinsics, scene.image_size, scene.points)
            look_from(client, view)

    def _move(self, client_id: int, client: Any, span: float) -> None:
        """Puts a browser behind the newest camera, unless its user has taken it elsewhere."""
        places = self._followers.get(client_id)
        if places is None or self._drawn is None or self._up is None:
            return
        here = np.array(client.camera.position)
        if not places:
            places.append(here)  # a slow browser may still tell of that when it was put elsewhere
        elif min(np.linalg.norm(here - place) for place in places) > 0.02 * span:
            self._followers.pop(client_id, None)
            return
        pose, depth = self._drawn.extrinsics[-1], self._drawn.newest.result.depth
        near = depth[np.isfinite(depth) & (depth > 0)]
        distance = float(np.median(near)) if len(near) else 1.0
        centre, forward = camera_centres(pose[None])[0], pose[2, :3]
        position = centre + distance * (_ABOVE * self._up - _BACK * forward)
        places.append(position)
        look_from(client, View(position, centre + distance * forward, self._up, float(np.radians(60))))
        client.camera.near, client.camera.far = span / 1000, 100 * span
