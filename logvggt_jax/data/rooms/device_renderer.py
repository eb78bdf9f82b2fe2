"""Renders rooms in JAX, all clips in one program: the same surfaces, textures and lights as `ray_caster`.

Everything is written out by components in float32: a matrix product would have the precision that the device chooses
for it. One thing after another is tried on all rays, which needs no memory for rays times things.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from logvggt_jax.data.rooms.intersections import box, chord, slab
from logvggt_jax.data.rooms.ray_caster import AMBIENT, FADING, SHADOW_BIAS
from logvggt_jax.data.rooms.textures import WAVES

_OF_FRAMES = ("rotations", "origins", "gains", "intrinsics")
Components = list[jax.Array]  # x, y and z of points or directions, arrays of one shape


def draw_clips(clips: Mapping[str, jax.Array], *, size: tuple[int, int]) -> dict[str, jax.Array]:
    """Clips as a training step takes them, from what `RoomScenes.describe` says of each.

    Args:
      clips: the arrays of `RoomScenes.describe`, each with a leading axis of B clips.
      size: (H, W) of the pictures.

    Returns:
      `images` uint8 [B, T, H, W, 3], `depth` float32 [B, T, H, W], `intrinsics` and `extrinsics` as they came.
    """
    described = {name: value for name, value in clips.items() if name != "extrinsics"}
    # A CPU computes one frame after another, which then lies in its cache; others need all of them to be busy.
    each: Any = _one_by_one if jax.default_backend() == "cpu" else jax.vmap

    def draw_clip(clip: Mapping[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        cameras = {name: clip[name] for name in _OF_FRAMES}
        return each(lambda camera: _draw_frame({**clip, **camera}, size))(cameras)

    images, depth = each(draw_clip)(described)
    return {
        "images": images,
        "depth": depth,
        "intrinsics": clips["intrinsics"],
        "extrinsics": clips["extrinsics"],
    }


def _one_by_one(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return functools.partial(jax.lax.map, function)


def _draw_frame(frame: Mapping[str, jax.Array], size: tuple[int, int]) -> tuple[jax.Array, jax.Array]:
    """Image [H, W, 3] uint8 and depth [H, W] of a frame: a room and K cameras, over whose pictures it is the mean."""
    count = len(frame["rotations"])

    def expose(known: tuple[Components, jax.Array], camera: Any) -> tuple[tuple[Components, jax.Array], None]:
        colours, depth = known
        index, rotation, origin = camera
        found, found_depth = _expose(frame, rotation, origin, size)
        depth = jnp.where(index == count // 2, found_depth, depth)
        return ([old + new for old, new in zip(colours, found, strict=True)], depth), None

    nothing = jnp.zeros(size)
    cameras = (jnp.arange(count), frame["rotations"], frame["origins"])
    (colours, depth), _ = jax.lax.scan(expose, ([nothing] * 3, nothing), cameras)
    image = jnp.stack(colours, axis=-1) * (frame["gains"] / count)
    return jnp.clip(image + 0.5, 0.0, 255.0).astype(jnp.uint8), depth


def _expose(
    frame: Mapping[str, jax.Array], rotation: jax.Array, origin: jax.Array, size: tuple[int, int]
) -> tuple[Components, jax.Array]:
    """Red, green, blue (255 is white) and depth, each [H, W], seen by a camera of `rotation` [3, 3] at `origin` [3]."""
    height, width = size
    intrinsics = frame["intrinsics"]
    x = (jnp.arange(width) - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (jnp.arange(height) - intrinsics[1, 2]) / intrinsics[1, 1]
    # [H, W] each, along the axes of the world.
    rays = [
        _not_zero(rotation[0, axis] * x + (rotation[1, axis] * y + rotation[2, axis])[:, None]) for axis in range(3)
    ]
    start = list(origin)
    depth, surface = _cast(frame, start, rays)
    points = [start[axis] + depth * rays[axis] for axis in range(3)]
    pixel = depth / intrinsics[0, 0]
    return _colours(frame, surface, points, pixel), depth


def _cast(room: Mapping[str, jax.Array], start: Components, rays: Components) -> tuple[jax.Array, jax.Array]:
    """Ray parameter and number of the nearest surface on each ray, from inside the room."""
    half = room["half_size"]
    x, y, z = ((jnp.copysign(half[a], rays[a]) - start[a]) / rays[a] for a in range(3))
    depth = jnp.minimum(jnp.minimum(x, y), z)
    surface = jnp.where(
        depth == x, 0 + (rays[0] > 0), jnp.where(depth == y, 2 + (rays[1] > 0), 4 + (rays[2] > 0))
    ).astype(jnp.int32)
    first_sphere = 6 + 6 * len(room["boxes"])
    first_cylinder = first_sphere + len(room["spheres"])

    def meet_box(number: jax.Array, thing: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        near, enter, leave, turned = _through_box(thing, start, rays)
        # A ray enters by the positive face where it runs in the negative direction.
        face = jnp.where(
            enter == near[0], 0 + (turned[0] < 0), jnp.where(enter == near[1], 2 + (turned[1] < 0), 4 + (turned[2] < 0))
        )
        return enter, enter <= leave, 6 + 6 * number + face

    def meet_sphere(number: jax.Array, thing: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        enter, leave = _through_sphere(thing, start, rays)
        return enter, enter < leave, first_sphere + number

    def meet_cylinder(number: jax.Array, thing: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        side, cap, leave = _through_cylinder(thing, start, rays)
        enter = jnp.maximum(side, cap)
        return enter, enter <= leave, first_cylinder + 2 * number + (cap > side)

    for things, meet in ((room["boxes"], meet_box), (room["spheres"], meet_sphere), (room["cylinders"], meet_cylinder)):
        depth, surface = _nearest(things, meet, depth, surface)
    return depth, surface


def _nearest(
    things: jax.Array, meet: Callable[..., tuple[jax.Array, ...]], depth: jax.Array, surface: jax.Array
) -> tuple[jax.Array, jax.Array]:
    def one(known: tuple[jax.Array, jax.Array], item: tuple[jax.Array, jax.Array]) -> Any:
        depth, surface = known
        enter, hit, number = meet(*item)
        hit = hit & (enter > 0) & (enter < depth)
        return (jnp.where(hit, enter, depth), jnp.where(hit, number, surface)), None

    return jax.lax.scan(one, (depth, surface), (jnp.arange(len(things)), things))[0]


def _through_box(
    thing: jax.Array, start: Components, rays: Components
) -> tuple[Components, jax.Array, jax.Array, Components]:
    """As `intersections.box`, and the rays along the box's axes."""
    x, y, z = (start[axis] - thing[axis] for axis in range(3))
    cosine, sine = thing[6], thing[7]
    origin = [cosine * x - sine * z, y, sine * x + cosine * z]
    turned = [cosine * rays[0] - sine * rays[2], rays[1], sine * rays[0] + cosine * rays[2]]
    return *box(origin, [1.0 / _not_zero(each) for each in turned], list(thing[3:6])), turned


def _through_sphere(thing: jax.Array, start: Components, rays: Components) -> tuple[jax.Array, jax.Array]:
    middle, half = chord([start[axis] - thing[axis] for axis in range(3)], rays, thing[3])
    return middle - half, middle + half


def _through_cylinder(thing: jax.Array, start: Components, rays: Components) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where rays come within the side, between the caps, and where they leave the cylinder; NaN beside the side."""
    x, y, z = (start[axis] - thing[axis] for axis in range(3))
    middle, half = chord((x, z), (rays[0], rays[2]), thing[3])
    cap, end = slab(y, 1.0 / _not_zero(rays[1]), thing[4])
    return middle - half, cap, jnp.minimum(middle + half, end)


def _colours(room: Mapping[str, jax.Array], surface: jax.Array, points: Components, pixel: jax.Array) -> Components:
    """Red, green and blue of surfaces numbered `surface` at `points`, where pixels are `pixel` metres wide."""

    def of(table: jax.Array) -> jax.Array:
        return table[surface]

    def affine(slopes: jax.Array, offset: jax.Array) -> jax.Array:
        return of(offset) + sum(of(slopes[axis]) * points[axis] for axis in range(3))

    waves = [jnp.sin(affine(room["frequency"][k], room["phase"][k])) for k in range(WAVES)]
    noise = (waves[0] + waves[1] + waves[2] + waves[3]) * 0.25
    # An edge is never sharper than a pixel is wide, and a pattern finer than pixels fades out.
    softness = jnp.maximum(of(room["edge"]), of(room["pattern_frequency"]) * pixel)
    pattern = jnp.clip(waves[4] * waves[5] / softness, -1.0, 1.0)
    mix = 0.5 + 0.5 * (noise + of(room["pattern_weight"]) * (pattern - noise))
    brightness = affine(room["shade"][:3], room["shade"][3]) * 255.0
    if len(room["lights"]):
        slope, offset = room["normal_slope"], room["normal_offset"]
        normal = [of(slope[axis]) * points[axis] + of(offset[axis]) for axis in range(3)]
        brightness = AMBIENT * brightness + 255.0 * _light(room, points, normal)
    first, second = room["colour"]
    return [(of(a) + mix * (of(b) - of(a))) * brightness for a, b in zip(first, second, strict=True)]


def _light(room: Mapping[str, jax.Array], points: Components, normal: Components) -> jax.Array:
    """Brightness by all lamps together of surfaces at `points` with `normal`."""
    start = [point + SHADOW_BIAS * slope for point, slope in zip(points, normal, strict=True)]

    def add(total: jax.Array, lamp: jax.Array) -> tuple[jax.Array, None]:
        way = [lamp[axis] - start[axis] for axis in range(3)]
        squared = way[0] * way[0] + way[1] * way[1] + way[2] * way[2]
        facing = (normal[0] * way[0] + normal[1] * way[1] + normal[2] * way[2]) / jnp.sqrt(squared)
        light = lamp[3] * jnp.maximum(facing, 0.0) / (1.0 + squared / (FADING * FADING))
        return total + jnp.where(_hidden(room, start, way), 0.0, light), None

    return jax.lax.scan(add, jnp.zeros_like(points[0]), room["lights"])[0]


def _hidden(room: Mapping[str, jax.Array], start: Components, way: Components) -> jax.Array:
    """Whether furniture lies between points `start` and `start` + `way`."""

    def hide_box(thing: jax.Array) -> tuple[jax.Array, jax.Array]:
        _, enter, leave, _ = _through_box(thing, start, way)
        return enter, leave

    def hide_sphere(thing: jax.Array) -> tuple[jax.Array, jax.Array]:
        return _through_sphere(thing, start, way)

    def hide_cylinder(thing: jax.Array) -> tuple[jax.Array, jax.Array]:
        side, cap, leave = _through_cylinder(thing, start, way)
        return jnp.maximum(side, cap), leave

    hidden = jnp.zeros(start[0].shape, bool)
    for things, through in (
        (room["boxes"], hide_box),
        (room["spheres"], hide_sphere),
        (room["cylinders"], hide_cylinder),
    ):

        def add(known: jax.Array, thing: jax.Array, through: Any = through) -> tuple[jax.Array, None]:
            enter, leave = through(thing)
            return known | ((enter <= leave) & (leave > 0) & (enter < 1)), None

        hidden, _ = jax.lax.scan(add, hidden, things)
    return hidden


def _not_zero(values: jax.Array) -> jax.Array:
    """`values` without zeros, which would make 0 * inf."""
    return jnp.where(values == 0, 1e-12, values)
