"""Random furnished rooms: geometry, and textures as small tables that the ray caster looks up."""

from dataclasses import dataclass

import numpy as np

from logvggt_jax.data.rooms.trajectories import Trajectory, random_trajectory

STYLES = ("compass", "random")
WAVES = 6  # sine waves of a texture: four of smooth noise, two whose product is a checker or stripe pattern
CLEARANCE = 0.3  # metres between the camera's path and any furniture
_PATH_SAMPLES = 512
_ATTEMPTS = 40

# Walls -x, +x, ceiling -y, floor +y, walls -z, +z: the order of the surfaces of a room.
_COMPASS_COLOURS = np.array(
    [
        [0.80, 0.34, 0.30],
        [0.36, 0.70, 0.40],
        [0.88, 0.88, 0.86],
        [0.46, 0.38, 0.33],
        [0.34, 0.44, 0.84],
        [0.86, 0.76, 0.34],
    ]
)


@dataclass(frozen=True)
class Textures:
    """Per-surface tables, float32, S surfaces. A texture is a function of the world point p (metres).

    wave_k(p) = sin(frequency[k] . p + phase[k]). The mixing weight between the two colours is
    1/2 + 1/2 (pattern_weight * clip(wave_4 wave_5 / edge) + (1 - pattern_weight) * mean(wave_0 … wave_3)).
    """

    colour: np.ndarray  # [2, 3, S], RGB in [0, 1]
    frequency: np.ndarray  # [WAVES, 3, S], radians a metre
    phase: np.ndarray  # [WAVES, S]
    pattern_weight: np.ndarray  # [S]
    edge: np.ndarray  # [S], softness of the pattern's edges; 1 is a sine wave, small values are sharp
    pattern_frequency: np.ndarray  # [S], radians a metre, of the finer of the pattern's waves
    shade: np.ndarray  # [4, S], brightness as an affine function of p: shade[:3] . p + shade[3].


@dataclass(frozen=True)
class Room:
    """A box room around the origin, y down, with furniture and a camera path that keeps clear of it.

    Surfaces are numbered: 6 faces of the room (axis * 2 + positive side), 6 for each box, 1 for each sphere,
    2 for each cylinder (side, caps).

    Attributes:
      half_size: [3] float64, half extents in metres.
      box_centres, box_half_sizes: [N, 3] float64; box_yaws: [N] float64 radians about y.
      sphere_centres: [N, 3] float64; sphere_radii: [N] float64.
      cylinder_centres: [N, 3] float64; cylinder_radii, cylinder_half_heights: [N] float64; axes along y.
      textures: of all surfaces.
      trajectory: the camera's path.
      focal: focal length in units of the image width.
    """

    half_size: np.ndarray
    box_centres: np.ndarray
    box_half_sizes: np.ndarray
    box_yaws: np.ndarray
    sphere_centres: np.ndarray
    sphere_radii: np.ndarray
    cylinder_centres: np.ndarray
    cylinder_radii: np.ndarray
    cylinder_half_heights: np.ndarray
    textures: Textures
    trajectory: Trajectory
    focal: float

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Distance [N] in metres from points [N, 3] to the nearest furniture; 0 inside, inf without furniture."""
        distances = [np.full(len(points), np.inf)]
        for centre, half_size, yaw in zip(self.box_centres, self.box_half_sizes, self.box_yaws, strict=True):
            distances.append(_box_distance(points, centre, half_size, yaw))
        for centre, radius in zip(self.sphere_centres, self.sphere_radii, strict=True):
            distances.append(_sphere_distance(points, centre, radius))
        cylinders = zip(self.cylinder_centres, self.cylinder_radii, self.cylinder_half_heights, strict=True)
        for centre, radius, half_height in cylinders:
            distances.append(_cylinder_distance(points, centre, radius, half_height))
        return np.min(distances, axis=0)


def random_room(rng: np.random.Generator, style: str) -> Room:
    """A random room of `style`.

    `compass`: nearly one size, every wall, floor and ceiling in its own colour in all rooms (jitter 0.08), so
    that absolute heading can be read off an image; 5 boxes, 2 spheres, 2 cylinders. `random`: sizes and colours
    vary freely; 8 boxes, 4 spheres, 3 cylinders. Textures are random in both. Furniture that finds no place
    clear of the camera's path in 40 attempts is left out.
    """
    if style not in STYLES:
        raise ValueError(f"unknown room style {style!r}: choose one of {', '.join(STYLES)}")
    compass = style == "compass"
    if compass:
        half_size = np.array([3.0, 1.3, 2.4]) * rng.uniform(0.95, 1.05, 3)
        counts, focal = (5, 2, 2), float(rng.uniform(0.55, 0.75))
    else:
        half_size = np.array([rng.uniform(2.0, 3.5), rng.uniform(1.1, 1.5), rng.uniform(2.0, 3.5)])
        counts, focal = (8, 4, 3), float(rng.uniform(0.55, 0.90))
    trajectory = random_trajectory(rng, half_size)
    path = trajectory.positions(np.linspace(0.0, 2.0 * np.pi, _PATH_SAMPLES, endpoint=False))

    boxes = [_place_box(rng, half_size, path) for _ in range(counts[0])]
    spheres = [_place_sphere(rng, half_size, path) for _ in range(counts[1])]
    cylinders = [_place_cylinder(rng, half_size, path) for _ in range(counts[2])]
    box = np.array([b for b in boxes if b is not None]).reshape(-1, 7)
    sphere = np.array([s for s in spheres if s is not None]).reshape(-1, 4)
    cylinder = np.array([c for c in cylinders if c is not None]).reshape(-1, 5)
    return Room(
        half_size=half_size,
        box_centres=box[:, :3],
        box_half_sizes=box[:, 3:6],
        box_yaws=box[:, 6],
        sphere_centres=sphere[:, :3],
        sphere_radii=sphere[:, 3],
        cylinder_centres=cylinder[:, :3],
        cylinder_radii=cylinder[:, 3],
        cylinder_half_heights=cylinder[:, 4],
        textures=_random_textures(rng, box, sphere, cylinder, _COMPASS_COLOURS if compass else None),
        trajectory=trajectory,
        focal=focal,
    )


def _place_box(rng: np.random.Generator, room: np.ndarray, path: np.ndarray) -> np.ndarray | None:
    """Centre (3), half size (3) and yaw (1) of a box on the floor, or None."""
    for _ in range(_ATTEMPTS):
        half = np.array([rng.uniform(0.15, 0.55), rng.uniform(0.15, 0.8), rng.uniform(0.15, 0.55)])
        centre = np.array([rng.uniform(-1, 1) * room[0], room[1] - half[1], rng.uniform(-1, 1) * room[2]])
        yaw = rng.uniform(0.0, np.pi)
        if _box_distance(path, centre, half, yaw).min() > CLEARANCE:
            return np.concatenate([centre, half, [yaw]])
    return None


def _place_sphere(rng: np.random.Generator, room: np.ndarray, path: np.ndarray) -> np.ndarray | None:
    """Centre (3) and radius (1) of a sphere on the floor or in the air, or None."""
    for _ in range(_ATTEMPTS):
        radius = rng.uniform(0.15, 0.45)
        height = rng.choice([room[1] - radius, rng.uniform(-1, 1) * (room[1] - radius)])
        centre = np.array([rng.uniform(-1, 1) * room[0], height, rng.uniform(-1, 1) * room[2]])
        if _sphere_distance(path, centre, radius).min() > CLEARANCE:
            return np.array([*centre, radius])
    return None


def _place_cylinder(rng: np.random.Generator, room: np.ndarray, path: np.ndarray) -> np.ndarray | None:
    """Centre (3), radius (1) and half height (1) of an upright cylinder on the floor, or None."""
    for _ in range(_ATTEMPTS):
        radius, half_height = rng.uniform(0.1, 0.35), rng.uniform(0.2, room[1])
        centre = np.array([rng.uniform(-1, 1) * room[0], room[1] - half_height, rng.uniform(-1, 1) * room[2]])
        if _cylinder_distance(path, centre, radius, half_height).min() > CLEARANCE:
            return np.array([*centre, radius, half_height])
    return None


def _box_distance(points: np.ndarray, centre: np.ndarray, half_size: np.ndarray, yaw: float) -> np.ndarray:
    offset = points - centre
    cosine, sine = np.cos(yaw), np.sin(yaw)
    x, z = cosine * offset[:, 0] - sine * offset[:, 2], sine * offset[:, 0] + cosine * offset[:, 2]
    outside = np.maximum(np.abs(np.stack([x, offset[:, 1], z], axis=1)) - half_size, 0.0)
    return np.linalg.norm(outside, axis=1)


def _sphere_distance(points: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    return np.maximum(np.linalg.norm(points - centre, axis=1) - radius, 0.0)


def _cylinder_distance(points: np.ndarray, centre: np.ndarray, radius: float, half_height: float) -> np.ndarray:
    offset = points - centre
    radial = np.maximum(np.hypot(offset[:, 0], offset[:, 2]) - radius, 0.0)
    return np.hypot(radial, np.maximum(np.abs(offset[:, 1]) - half_height, 0.0))


def _random_textures(
    rng: np.random.Generator, box: np.ndarray, sphere: np.ndarray, cylinder: np.ndarray, room_colours: np.ndarray | None
) -> Textures:
    # Normals that face the viewer: into the room on its faces, outwards on furniture; NaN on curved surfaces.
    axes = np.concatenate([np.eye(3)[:, None] * -1, np.eye(3)[:, None]], axis=1).reshape(6, 3)
    normals = [-axes]
    for yaw in box[:, 6]:
        cosine, sine = np.cos(yaw), np.sin(yaw)
        normals.append(axes @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]]))
    normals.append(np.zeros((len(sphere) + 2 * len(cylinder), 3)))
    normal = np.concatenate(normals)
    count, first_curved = len(normal), 6 + 6 * len(box)
    owner = np.concatenate([np.arange(6), 6 + np.arange(6 * len(box)) // 6, np.full(count - first_curved, -1)])
    owner[first_curved : first_curved + len(sphere)] = 6 + len(box) + np.arange(len(sphere))
    owner[first_curved + len(sphere) :] = 6 + len(box) + len(sphere) + np.arange(2 * len(cylinder)) // 2
    bodies = owner.max() + 1
    of_room = np.arange(bodies) < 6

    base = rng.uniform(0.15, 0.95, (bodies, 3))
    if room_colours is not None:
        base[:6] = room_colours + rng.uniform(-0.08, 0.08, (6, 3))
    second = base * rng.uniform(0.35, 0.7, (bodies, 1)) + rng.uniform(-0.06, 0.06, (bodies, 3))
    finest = np.where(of_room, rng.uniform(0.35, 0.9, bodies), rng.uniform(0.14, 0.4, bodies))
    periods = np.concatenate([finest * rng.uniform(1.0, 4.0, (4, bodies)), np.tile(finest, (2, 1))])
    direction = rng.normal(size=(bodies, WAVES, 3))
    stripes = rng.random(bodies) < 0.35

    frequency = np.empty((WAVES, 3, count))
    for surface in range(count):
        body = owner[surface]
        waves = direction[body].copy()
        flat = normal[surface]
        if flat.any():
            # Only the part within the plane makes a pattern there; the two pattern waves cross at right angles.
            waves -= (waves @ flat)[:, None] * flat
            waves[5] = np.cross(flat, waves[4])
        waves *= (2.0 * np.pi / periods[:, body] / np.maximum(np.linalg.norm(waves, axis=1), 1e-6))[:, None]
        frequency[:, :, surface] = waves
    phase = rng.uniform(0.0, 2.0 * np.pi, (WAVES, bodies))[:, owner]
    striped = stripes[owner]
    frequency[5][:, striped] = 0.0
    phase[5, striped] = np.pi / 2

    light = rng.normal(size=3)
    light /= np.linalg.norm(light)
    shade = np.zeros((4, count))
    shade[3] = 0.8 + 0.2 * normal @ light
    for index, (centre, radius) in enumerate(zip(sphere[:, :3], sphere[:, 3], strict=True)):
        slope = 0.2 * light / radius
        shade[:, first_curved + index] = [*slope, 0.8 - slope @ centre]
    for index, (centre, radius) in enumerate(zip(cylinder[:, :3], cylinder[:, 3], strict=True)):
        slope = 0.2 * light / radius * np.array([1.0, 0.0, 1.0])
        shade[:, first_curved + len(sphere) + 2 * index] = [*slope, 0.8 - slope @ centre]

    colour = np.clip(np.stack([base, second]), 0.0, 1.0)[:, owner].transpose(0, 2, 1)
    tables = {
        "colour": colour,
        "frequency": frequency,
        "phase": phase,
        "pattern_weight": rng.uniform(0.3, 0.8, bodies)[owner],
        "edge": rng.uniform(0.05, 0.6, bodies)[owner],
        "pattern_frequency": 2.0 * np.pi / finest[owner],
        "shade": shade,
    }
    return Textures(**{name: np.ascontiguousarray(table, np.float32) for name, table in tables.items()})
