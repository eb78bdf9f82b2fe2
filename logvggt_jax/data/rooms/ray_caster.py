"""Renders a room: every pixel's ray against closed-form surfaces, in numpy.

Rays are scaled so that their camera z is 1; the ray parameter is then the z-depth itself, exact to float32.
Furniture is tested only inside the image rectangle that bounds it.
"""

from collections.abc import Sequence

import numpy as np

from logvggt_jax.data.rooms.intersections import box, chord, slab
from logvggt_jax.data.rooms.layout import Room
from logvggt_jax.data.rooms.textures import WAVES

AMBIENT = 0.35
"""Share of the brightness without lamps that reaches everything beside their light."""
FADING = 2.5  # metres from a lamp at which half of its light is left
SHADOW_BIAS = 2e-3  # metres by which shadow rays start off their surface, so that it does not shade itself
_NEAR = 0.02  # metres: corners nearer than this make the bounding rectangle the whole image
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)


class _View:
    """Rays of one camera and the nearest surface found on each so far."""

    def __init__(self, extrinsics: np.ndarray, intrinsics: np.ndarray, height: int, width: int) -> None:
        rotation = extrinsics[:3, :3]
        self.extrinsics, self.intrinsics = extrinsics, intrinsics
        self.origin = -rotation.T @ extrinsics[:3, 3]
        x = (np.arange(width) - intrinsics[0, 2]) / intrinsics[0, 0]
        y = (np.arange(height) - intrinsics[1, 2]) / intrinsics[1, 1]
        # [3, H, W] in world axes; zero components would make 0 * inf below.
        columns = (rotation[0][:, None, None] * x).astype(np.float32)
        rows = (rotation[1][:, None] * y + rotation[2][:, None]).astype(np.float32)
        self.rays = columns + rows[:, :, None]
        self.rays[self.rays == 0] = 1e-12
        self.inverse = 1.0 / self.rays
        self.depth = np.full((height, width), np.inf, np.float32)
        self.surface = np.zeros((height, width), np.intp)

    def rectangle(self, corners: np.ndarray) -> tuple[slice, slice] | None:
        """Rows and columns that the hull of world points [8, 3] can touch; None if it is out of sight."""
        height, width = self.depth.shape
        camera = corners @ self.extrinsics[:3, :3].T + self.extrinsics[:3, 3]
        z = camera[:, 2]
        if z.max() <= _NEAR:
            return None
        if z.min() <= _NEAR:
            return slice(0, height), slice(0, width)
        u = camera[:, 0] / z * self.intrinsics[0, 0] + self.intrinsics[0, 2]
        v = camera[:, 1] / z * self.intrinsics[1, 1] + self.intrinsics[1, 2]
        left, right = max(int(u.min()), 0), min(int(u.max()) + 1, width - 1)
        top, bottom = max(int(v.min()), 0), min(int(v.max()) + 1, height - 1)
        if left > right or top > bottom:
            return None
        return slice(top, bottom + 1), slice(left, right + 1)

    def keep_nearest(
        self, where: tuple[slice, slice], depth: np.ndarray, hit: np.ndarray, surface: np.ndarray | int
    ) -> None:
        """Records `surface` (number or array) where `hit` and `depth` beats what is known in the rectangle."""
        nearest = self.depth[where]
        hit = hit & (depth > 0) & (depth < nearest)
        np.copyto(nearest, depth, where=hit)
        np.copyto(self.surface[where], surface, where=hit)


def render(
    room: Room, exposures: Sequence[np.ndarray], intrinsics: np.ndarray, height: int, width: int, *, gain: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Image [H, W, 3] uint8 and z-depth [H, W] float32 in metres of `room`.

    The image is the mean over the cameras `exposures` (one is enough; several blur what moves), made brighter by
    `gain`; depth is that of the middle one. Each is [4, 4] world-to-camera (OpenCV), the camera inside the room;
    `intrinsics` [3, 3] in pixels with centres at integers. Deterministic: no randomness, no threads, one frame at a
    time.
    """
    views = [_cast(room, extrinsics, intrinsics, height, width) for extrinsics in exposures]
    colours = _colours(views[0], room)
    for view in views[1:]:
        colours += _colours(view, room)
    colours *= np.float32(gain / len(views))
    image = np.clip(colours + np.float32(0.5), 0.0, 255.0).astype(np.uint8)
    return image.reshape(height, width, 3), views[len(views) // 2].depth


def _cast(room: Room, extrinsics: np.ndarray, intrinsics: np.ndarray, height: int, width: int) -> _View:
    view = _View(np.asarray(extrinsics, np.float64), np.asarray(intrinsics, np.float64), height, width)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        _cast_room(view, room)
        _cast_boxes(view, room)
        _cast_spheres(view, room)
        _cast_cylinders(view, room)
    return view


def _cast_room(view: _View, room: Room) -> None:
    half, origin = room.half_size.astype(np.float32), view.origin.astype(np.float32)
    x, y, z = ((np.copysign(half[a], view.rays[a]) - origin[a]) * view.inverse[a] for a in range(3))
    np.minimum(np.minimum(x, y), z, out=view.depth)
    axis = np.where(view.depth == x, 0, np.where(view.depth == y, 1, 2))
    positive = np.where(axis == 0, view.rays[0] > 0, np.where(axis == 1, view.rays[1] > 0, view.rays[2] > 0))
    np.add(2 * axis, positive, out=view.surface)


def _cast_boxes(view: _View, room: Room) -> None:
    for index, (centre, half_size, yaw) in enumerate(
        zip(room.box_centres, room.box_half_sizes, room.box_yaws, strict=True)
    ):
        cosine, sine = np.cos(yaw), np.sin(yaw)
        to_box = np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
        where = view.rectangle(centre + (_CORNERS * half_size) @ to_box)
        if where is None:
            continue
        origin = (to_box @ (view.origin - centre)).astype(np.float32)
        half, cosine, sine = half_size.astype(np.float32), np.float32(cosine), np.float32(sine)
        dx, dy, dz = (view.rays[a][where] for a in range(3))
        rays = (cosine * dx - sine * dz, dy, sine * dx + cosine * dz)
        near, enter, leave = box(origin, (1.0 / rays[0], view.inverse[1][where], 1.0 / rays[2]), half)
        entered = np.where(enter == near[0], 0, np.where(enter == near[1], 1, 2))
        # A ray enters by the positive face where it runs in the negative direction.
        positive = np.where(entered == 0, rays[0] < 0, np.where(entered == 1, rays[1] < 0, rays[2] < 0))
        view.keep_nearest(where, enter, enter <= leave, 6 + 6 * index + 2 * entered + positive)


def _cast_spheres(view: _View, room: Room) -> None:
    first = 6 + 6 * len(room.box_centres)
    for index, (centre, radius) in enumerate(zip(room.sphere_centres, room.sphere_radii, strict=True)):
        where = view.rectangle(centre + _CORNERS * radius)
        if where is None:
            continue
        origin = (view.origin - centre).astype(np.float32)
        middle, half = chord(origin, [rays[where] for rays in view.rays], np.float32(radius * radius))
        view.keep_nearest(where, middle - half, half > 0, first + index)


def _cast_cylinders(view: _View, room: Room) -> None:
    first = 6 + 6 * len(room.box_centres) + len(room.sphere_centres)
    cylinders = zip(room.cylinder_centres, room.cylinder_radii, room.cylinder_half_heights, strict=True)
    for index, (centre, radius, half_height) in enumerate(cylinders):
        where = view.rectangle(centre + _CORNERS * [radius, half_height, radius])
        if where is None:
            continue
        x, y, z = (view.origin - centre).astype(np.float32)
        middle, half = chord((x, z), (view.rays[0][where], view.rays[2][where]), np.float32(radius * radius))
        cap, end = slab(y, view.inverse[1][where], np.float32(half_height))
        side = middle - half
        enter, leave = np.maximum(side, cap), np.minimum(middle + half, end)
        surface = first + 2 * index + (cap > side)
        view.keep_nearest(where, enter, (half > 0) & (enter <= leave), surface)


def _colours(view: _View, room: Room) -> np.ndarray:
    """Colours [H * W, 3] float32 before they are rounded, 255 is white."""
    textures = room.textures
    depth, surface = view.depth.ravel(), view.surface.ravel()
    points = [np.float32(view.origin[a]) + depth * view.rays[a].ravel() for a in range(3)]

    def affine(slopes: np.ndarray, offset: np.ndarray) -> np.ndarray:
        total = offset[surface]
        for axis in range(3):
            total += slopes[axis][surface] * points[axis]
        return total

    waves = [np.sin(affine(textures.frequency[k], textures.phase[k])) for k in range(WAVES)]
    noise = (waves[0] + waves[1] + waves[2] + waves[3]) * np.float32(0.25)
    # An edge is never sharper than a pixel is wide, and a pattern finer than pixels fades out.
    pixel = depth * np.float32(1.0 / view.intrinsics[0, 0])
    softness = np.maximum(textures.edge[surface], textures.pattern_frequency[surface] * pixel)
    pattern = np.clip(waves[4] * waves[5] / softness, -1.0, 1.0)
    weight = textures.pattern_weight[surface]
    mix = np.float32(0.5) + np.float32(0.5) * (noise + weight * (pattern - noise))
    brightness: np.ndarray = affine(textures.shade[:3], textures.shade[3]) * np.float32(255.0)
    if len(room.lights):
        normal = [textures.normal_slope[a][surface] * points[a] + textures.normal_offset[a][surface] for a in range(3)]
        brightness = np.float32(AMBIENT) * brightness + np.float32(255.0) * _light(room, points, normal)
    colours = np.empty((*depth.shape, 3), np.float32)
    for channel in range(3):
        first = textures.colour[0, channel][surface]
        colour = first + mix * (textures.colour[1, channel][surface] - first)
        colours[:, channel] = colour * brightness
    return colours


def _light(room: Room, points: list[np.ndarray], normal: list[np.ndarray]) -> np.ndarray:
    """Brightness [N] by all lamps together of surfaces at `points` with `normal`, three arrays [N] each."""
    start = [point + np.float32(SHADOW_BIAS) * slope for point, slope in zip(points, normal, strict=True)]
    total = np.zeros_like(points[0])
    for *lamp, power in room.lights.astype(np.float32):
        way = [lamp[axis] - start[axis] for axis in range(3)]
        squared = way[0] * way[0] + way[1] * way[1] + way[2] * way[2]
        facing = (normal[0] * way[0] + normal[1] * way[1] + normal[2] * way[2]) / np.sqrt(squared)
        light = power * np.maximum(facing, 0.0) / (1.0 + squared / np.float32(FADING * FADING))
        total += np.where(_hidden(room, start, way), np.float32(0.0), light)
    return total


def _hidden(room: Room, start: list[np.ndarray], way: list[np.ndarray]) -> np.ndarray:
    """Whether furniture lies between points `start` and `start` + `way`, three arrays [N] each."""
    hidden = np.zeros(start[0].shape, bool)

    def add(enter: np.ndarray, leave: np.ndarray) -> None:
        nonlocal hidden
        hidden |= (enter <= leave) & (leave > 0) & (enter < 1)

    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for centre, half_size, yaw in zip(room.box_centres, room.box_half_sizes, room.box_yaws, strict=True):
            cosine, sine = np.float32(np.cos(yaw)), np.float32(np.sin(yaw))
            x, y, z = (start[axis] - np.float32(centre[axis]) for axis in range(3))
            origin = (cosine * x - sine * z, y, sine * x + cosine * z)
            rays = (cosine * way[0] - sine * way[2], way[1], sine * way[0] + cosine * way[2])
            _, enter, leave = box(origin, [_inverse(each) for each in rays], half_size.astype(np.float32))
            add(enter, leave)
        for centre, radius in zip(room.sphere_centres, room.sphere_radii, strict=True):
            offset = [start[axis] - np.float32(centre[axis]) for axis in range(3)]
            middle, half = chord(offset, way, np.float32(radius * radius))
            add(middle - half, middle + half)
        cylinders = zip(room.cylinder_centres, room.cylinder_radii, room.cylinder_half_heights, strict=True)
        for centre, radius, half_height in cylinders:
            x, y, z = (start[axis] - np.float32(centre[axis]) for axis in range(3))
            middle, half = chord((x, z), (way[0], way[2]), np.float32(radius * radius))
            cap, end = slab(y, _inverse(way[1]), np.float32(half_height))
            add(np.maximum(middle - half, cap), np.minimum(middle + half, end))
    return hidden


def _inverse(way: np.ndarray) -> np.ndarray:
    """1 / way; a way of zero, which would make 0 * inf, is next to nothing."""
    return 1.0 / np.where(way == 0, np.float32(1e-12), way)
