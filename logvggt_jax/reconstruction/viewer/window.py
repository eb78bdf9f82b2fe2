"""What the viewer's page shows and what its controls do; viser draws it."""

from __future__ import annotations

import contextlib
import io
import threading
from typing import Any

import numpy as np
from PIL import Image

from logvggt_jax.colours import depth_picture
from logvggt_jax.frames import evenly_spaced
from logvggt_jax.geometry import camera_centres
from logvggt_jax.reconstruction.depth_files import IMAGE_FOLDER
from logvggt_jax.reconstruction.previews import depth_range
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.viewer.colouring import IMAGE, colourings, level_limits, point_colours
from logvggt_jax.reconstruction.viewer.detail import USUALLY_SHOWN, Detail, levels_of_detail
from logvggt_jax.reconstruction.viewer.drawing import (
    MOST_FRUSTA,
    PRESENT,
    camera_size,
    draw_camera,
    draw_path,
    draw_points,
    look_from,
    set_ground,
    shrunk,
)
from logvggt_jax.reconstruction.viewer.opening_view import (
    View,
    camera_view,
    opening_view,
    point_spacing,
    scene_span,
)

_SCREENSHOT = (1080, 1920)
# From which the scale of colours is taken.
_SCALE_POINTS = 200_000


class Window:
    """Puts a reconstruction and its controls on the page of a viser server.

    Args:
      server: `viser.ViserServer`, which nothing else draws on.
      result: the reconstruction.

    Raises:
      InputError: a file of the result is damaged.
    """

    def __init__(self, server: Any, result: Reconstruction) -> None:
        self._server, self._result = server, result
        self._cloud = result.cloud()
        self._detail = Detail(self._cloud)
        self._centres = camera_centres(result.extrinsics)
        self._span = scene_span(self._cloud.points, self._centres)
        self._view = opening_view(result.extrinsics, result.intrinsics, result.image_size, self._cloud.points)
        sample = self._detail.choose(_SCALE_POINTS)
        # The ends of each scale are the same whatever part of the cloud is shown.
        self._limits = {each: level_limits(each, self._cloud, sample, result) for each in colourings(self._cloud)}
        self._depth_range = depth_range(result)
        self._has_images = (result.folder / IMAGE_FOLDER).exists()  # results of earlier versions have none
        # Callbacks come in threads of the server's, and some call one another.
        self._lock = threading.RLock()
        self._shown: int | None = None
        self._spacing = point_spacing(self._span, 0)
        self._playing: threading.Event | None = None
        self._open_at(self._view)
        self._add_controls()
        self._draw_cameras()
        self._set_ground()
        self._show_frame()

    def _open_at(self, view: View) -> None:
        self._server.scene.set_up_direction(tuple(view.up))
        camera = self._server.initial_camera
        camera.position, camera.look_at = tuple(view.position), tuple(view.target)
        camera.fov, camera.near, camera.far = view.field_of_view, self._span / 1000, 100 * self._span

    def _add_controls(self) -> None:
        gui, frames, points = self._server.gui, self._result.num_frames, len(self._cloud.points)
        levels = levels_of_detail(points)
        with gui.add_folder("Points"):
            self.colouring = gui.add_dropdown("colour", colourings(self._cloud), initial_value=IMAGE)
            self.point_size = gui.add_slider("size", 0.1, 4.0, 0.1, 1.0)
            self.left_out = gui.add_slider("least sure, % hidden", 0, 99, 1, 0, disabled=self._cloud.confidence is None)
            usual = next((each for each in levels if each <= USUALLY_SHOWN), levels[-1])
            self.most = gui.add_dropdown(f"of {points:,}", [f"{each:,}" for each in levels], initial_value=f"{usual:,}")
        with gui.add_folder("Frames"):
            self.frame = gui.add_slider("frame", 0, max(frames - 1, 1), 1, 0, disabled=frames == 1)
            self.alone = gui.add_checkbox("its points alone", False, disabled=self._cloud.frame is None)
            self.play = gui.add_checkbox("play", False, disabled=frames == 1)
            self.rate = gui.add_slider("frames a second", 1, 30, 1, 8)
            jump = gui.add_button("look through this camera")
            self._image = gui.add_image(np.zeros((1, 1, 3), np.uint8), label="image", visible=self._has_images)
            self._depth = gui.add_image(np.zeros((1, 1, 3), np.uint8), label="depth")
        with gui.add_folder("View"):
            self.dark = gui.add_checkbox("dark ground", True)
            self.cameras = gui.add_checkbox("cameras", True)
            home = gui.add_button("where it began")
            fly = gui.add_button("fly along the cameras")
            screenshot = gui.add_button("screenshot")
        for control in (self.colouring, self.left_out, self.most, self.alone):
            control.on_update(lambda _: self._draw_points())
        self.point_size.on_update(lambda _: self._set_point_size())
        self.frame.on_update(lambda _: self._show_frame())
        self.play.on_update(lambda _: self._start_or_stop())
        self.dark.on_update(lambda _: self._set_ground())
        self.cameras.on_update(lambda _: self._show_cameras())
        jump.on_click(lambda event: self._look_through(event.client, int(self.frame.value)))
        home.on_click(lambda event: self._go_home(event.client))
        fly.on_click(lambda event: self._fly(event.client))
        screenshot.on_click(lambda event: self._screenshot(event.client))

    def _draw_points(self) -> None:
        with self._lock:
            frame = int(self.frame.value) if self.alone.value else None
            lowest = self._detail.confidence_at(float(self.left_out.value))
            most = int(self.most.value.replace(",", ""))
            chosen = self._detail.choose(most, lowest=lowest, frame=frame)
            colouring = self.colouring.value
            colours = point_colours(colouring, self._cloud, chosen, self._result, self._limits[colouring])
            points = self._cloud.points[chosen]
            if frame is None:
                self._spacing = point_spacing(self._span, min(most, len(self._cloud.points)))
            elif len(points):
                self._spacing = point_spacing(scene_span(points, points[:1]), len(points))
            self.points = draw_points(self._server, points, colours, self._point_size)

    @property
    def _point_size(self) -> float:
        return float(self.point_size.value) * self._spacing

    def _set_point_size(self) -> None:
        with self._lock:
            self.points.point_size = self._point_size

    def _draw_cameras(self) -> None:
        self._frusta = []
        drawn = evenly_spaced(self._result.num_frames, MOST_FRUSTA)
        self._frustum_size = camera_size(self._centres[drawn], self._span)
        for index in drawn:
            frustum = self._frustum(f"/cameras/{index:06d}", index, size=self._frustum_size)
            frustum.on_click(lambda event, index=index: self._look_through(event.client, index))
            self._frusta.append(frustum)
        if len(self._centres) > 1:
            self._frusta.append(draw_path(self._server, self._centres))

    def _frustum(self, name: str, index: int, **options: Any) -> Any:
        result = self._result
        picture = result.image(index) if self._has_images else None
        camera = result.extrinsics[index], result.intrinsics[index]
        return draw_camera(self._server, name, *camera, result.image_size, picture=picture, **options)

    def _show_cameras(self) -> None:
        for drawn in (*self._frusta, self._present):
            drawn.visible = bool(self.cameras.value)

    def _show_frame(self) -> None:
        with self._lock:
            index = min(int(self.frame.value), self._result.num_frames - 1)
            if index == self._shown:
                return
            self._shown = index
            near, far = self._depth_range
            self._depth.image = shrunk(depth_picture(self._result.depth(index), near=near, far=far))
            self._depth.label = f"depth, {near:.3g} (yellow) to {far:.3g}{' m' if self._result.metric else ''}"
            if self._has_images:
                self._image.image = shrunk(self._result.image(index))
                self._image.label = f"{self._result.names[index]}, {self._result.timestamps[index]:g}"
            self._present = self._frustum("/present", index, size=1.6 * self._frustum_size, colour=PRESENT)
            self._present.visible = bool(self.cameras.value)
            if self.alone.value or not hasattr(self, "points"):
                self._draw_points()

    def _set_ground(self) -> None:
        set_ground(self._server, dark=bool(self.dark.value))

    def _camera_view(self, index: int) -> View:
        height = self._result.image_size[0]
        field_of_view = 2 * float(np.arctan(height / 2 / self._result.intrinsics[index, 1, 1]))
        distance = float(np.linalg.norm(self._view.target - self._centres[0])) or 1.0
        return camera_view(self._result.extrinsics[index], self._view.up, field_of_view, distance)

    def _look_through(self, client: Any, index: int) -> None:
        look_from(client, self._camera_view(index))
        self.cameras.value = False  # its own picture, and those of its neighbours, would stand in the way

    def _go_home(self, client: Any) -> None:
        look_from(client, self._view)
        self.cameras.value = True

    def _start_or_stop(self) -> None:
        with self._lock:
            if self._playing is not None:
                self._playing.set()
                self._playing = None
            if self.play.value:
                self._playing = threading.Event()
                threading.Thread(target=self._advance, args=(self._playing,), daemon=True).start()

    def _advance(self, stop: threading.Event) -> None:
        """Shows frame after frame, from the first again after the last."""
        with contextlib.suppress(RuntimeError):  # the server has stopped
            while not stop.wait(1 / float(self.rate.value)):
                self.frame.value = (int(self.frame.value) + 1) % self._result.num_frames
                self._show_frame()  # here, too, so that frames do not come faster than they can be shown

    def _fly(self, client: Any) -> None:
        """Takes one browser's camera through all the cameras, once."""
        stop = threading.Event()
        for index in range(self._result.num_frames):
            if client.client_id not in self._server.get_clients() or stop.wait(1 / float(self.rate.value)):
                return
            self._look_through(client, index)

    def _screenshot(self, client: Any) -> None:
        picture = client.get_render(*_SCREENSHOT, transport_format="png")
        content = io.BytesIO()
        Image.fromarray(picture[..., :3]).save(content, "PNG")
        name = f"{self._result.folder.resolve().name}.png"
        client.send_file_download(name, content.getvalue(), save_immediately=True)
