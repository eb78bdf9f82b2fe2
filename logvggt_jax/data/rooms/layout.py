"""Random furnished rooms, one or several in a row with doors between them."""

from dataclasses import dataclass, replace

import numpy as np

from logvggt_jax.data.rooms.textures import PIECES, Textures, random_textures
from logvggt_jax.data.rooms.trajectories import CameraPath, random_laps, random_trajectory, random_walk

STYLES = ("compass", "random")
MOST_ROOMS = 4
MOST_LIGHTS = 3
_FURNITURE = {"compass": (5, 2, 2), "random": (8, 4, 3)}  # boxes, spheres and cylinders of a room
_DOOR = (0.55, 2.1)  # half width and height of a door in metres
_LAMPS = 1.7  # brightness at no distance of all lamps of a room together
_HALF_WALL = 0.06  # half the thickness of a partition in metres
_BEYOND = 0.1  # metres by which partitions reach into outer walls, so that no two faces coincide in sight
CLEARANCE = 0.3  # metres between the camera's path and any furniture
_PATH_SAMPLES = 512
_ATTEMPTS = 40


@dataclass(frozen=True)
class Furnishing:
    """What makes rooms harder and closer to the world; the defaults add nothing."""

    repetition: float = 0.0  # share of bodies whose textures repeat exactly, as tiles and wallpaper do
    lights: int = 0  # point lights of each room, which cast hard shadows; 0 = brightness by direction alone
    clutter: int = 0  # small things more in each room, on the floor; half of them boxes against its walls
    rooms: int = 1  # rooms in a row along x, each with a door to the next
    laps: int = 1  # times that the camera walks round, each a little aside, before its path repeats

    def capacity(self, style: str) -> tuple[int, int, int]:
        """The most boxes, spheres and cylinders that a room of `style` has."""
        boxes, spheres, cylinders = _FURNITURE[style]
        extra = [_clutter_kind(index) for index in range(self.clutter)]
        return (
            self.rooms * (boxes + extra.count("box")) + PIECES * (self.rooms - 1),
            self.rooms * (spheres + extra.count("sphere")),
            self.rooms * (cylinders + extra.count("cylinder")),
        )


@dataclass(frozen=True)
class Room:
    """A box room around the origin, y down, with furniture and a camera path that keeps clear of it.

    Several rooms are one box with partitions, walls of three boxes around a door; they are the last boxes.

    Surfaces are numbered: 6 faces of the room (axis * 2 + positive side), 6 for each box, 1 for each sphere,
    2 for each cylinder (side, caps).

    Attributes:
      half_size: [3] float64, half extents in metres.
      box_centres, box_half_sizes: [N, 3] float64; box_yaws: [N] float64 radians about y.
      sphere_centres: [N, 3] float64; sphere_radii: [N] float64.
      cylinder_centres: [N, 3] float64; cylinder_radii, cylinder_half_heights: [N] float64; axes along y.
      lights: [N, 4] float64, places of point lights and their brightness at no distance; none without shadows.
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
    lights: np.ndarray
    textures: Textures
    trajectory: CameraPath
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


def random_room(rng: np.random.Generator, style: str, furnishing: Furnishing) -> Room:
    """A random room of `style`, or several in a row.

    `compass`: nearly one size, every wall, floor and ceiling in its own colour in all rooms (jitter 0.08), so
    that absolute heading can be read off an image; 5 boxes, 2 spheres, 2 cylinders. `random`: sizes and colours
    vary freely; 8 boxes, 4 spheres, 3 cylinders. Textures are random in both. Furniture that finds no place
    clear of the camera's path in 40 attempts is left out.
    """
    if style not in STYLES:
        raise ValueError(f"unknown room style {style!r}: choose one of {', '.join(STYLES)}")
    compass = style == "compass"
    if compass:
        single = np.array([3.0, 1.3, 2.4]) * rng.uniform(0.95, 1.05, 3)
        focal = float(rng.uniform(0.55, 0.75))
    else:
        single = np.array([rng.uniform(2.0, 3.5), rng.uniform(1.1, 1.5), rng.uniform(2.0, 3.5)])
        focal = float(rng.uniform(0.55, 0.90))
    half_size = single * [furnishing.rooms, 1.0, 1.0]
    # Middles of the rooms, and the doors from each to the next.
    middles = single[0] * (2.0 * np.arange(furnishing.rooms) - furnishing.rooms + 1.0)
    trajectory: CameraPath
    if furnishing.rooms == 1:
        doors = np.empty((0, 2))
        trajectory = random_trajectory(rng, half_size)
    else:
        doors = np.stack([middles[:-1] + single[0], rng.uniform(-0.5, 0.5, len(middles) - 1) * single[2]], axis=1)
        trajectory = random_walk(rng, _corners(rng, single, middles, doors))
    samples = _PATH_SAMPLES * furnishing.rooms * furnishing.laps
    if furnishing.laps > 1:
        trajectory = random_laps(rng, trajectory, furnishing.laps)
    path = trajectory.positions(np.linspace(0.0, 2.0 * np.pi * furnishing.laps, samples, endpoint=False))

    boxes, spheres, cylinders = _furniture(rng, single, middles, path, _FURNITURE[style], furnishing.clutter)
    boxes += [piece for x, z in doors for piece in _partition(half_size, x, z)]
    box = np.array(boxes).reshape(-1, 7)
    sphere = np.array(spheres).reshape(-1, 4)
    cylinder = np.array(cylinders).reshape(-1, 5)
    textures = random_textures(
        rng, box, len(doors), sphere, cylinder, compass=compass, repetition=furnishing.repetition
    )
    room = Room(
        half_size=half_size,
        box_centres=box[:, :3],
        box_half_sizes=box[:, 3:6],
        box_yaws=box[:, 6],
        sphere_centres=sphere[:, :3],
        sphere_radii=sphere[:, 3],
        cylinder_centres=cylinder[:, :3],
        cylinder_radii=cylinder[:, 3],
        cylinder_half_heights=cylinder[:, 4],
        lights=np.empty((0, 4)),
        textures=textures,
        trajectory=trajectory,
        focal=focal,
    )
    if not furnishing.lights:
        return room
    return replace(room, lights=_lamps(rng, room, single, middles, furnishing.lights))


def _furniture(
    rng: np.random.Generator,
    single: np.ndarray,
    middles: np.ndarray,
    path: np.ndarray,
    counts: tuple[int, int, int],
    clutter: int,
) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Boxes, spheres and cylinders of rooms of half extents `single` [3] with `middles` [N] along x."""
    boxes: list[np.ndarray] = []
    spheres: list[np.ndarray] = []
    cylinders: list[np.ndarray] = []
    small = {
        "box": (boxes, _place_small_box),
        "sphere": (spheres, _place_small_sphere),
        "cylinder": (cylinders, _place_small_cylinder),
    }
    for middle in middles:
        moved = path - [middle, 0.0, 0.0]
        boxes += _moved([_place_box(rng, single, moved) for _ in range(counts[0])], middle)
        spheres += _moved([_place_sphere(rng, single, moved) for _ in range(counts[1])], middle)
        cylinders += _moved([_place_cylinder(rng, single, moved) for _ in range(counts[2])], middle)
        for index in range(clutter):
            things, place = small[_clutter_kind(index)]
            things += _moved([place(rng, single, moved)], middle)
    return boxes, spheres, cylinders


def _lamps(rng: np.random.Generator, room: Room, single: np.ndarray, middles: np.ndarray, count: int) -> np.ndarray:
    """`count` lamps of each room, [N, 4] as `Room.lights`, near the ceiling, where furniture leaves most room."""
    lamps = []
    for middle in np.repeat(middles, count):
        places = rng.uniform((-0.7, -0.9, -0.7), (0.7, -0.6, 0.7), (8, 3)) * single + [middle, 0.0, 0.0]
        lamps.append([*places[room.clearance(places).argmax()], _LAMPS / count])
    return np.array(lamps)


def _corners(rng: np.random.Generator, room: np.ndarray, middles: np.ndarray, doors: np.ndarray) -> np.ndarray:
    """Corners [N, 3] of a way through all rooms and back, straight through the middle of every door.

    On the way out it passes the rooms on one side, on the way back on the other.
    """
    height = rng.uniform(-0.15, 0.1)
    side = rng.uniform(0.3, 0.55, (2, len(middles))) * room[2] * np.array([[-1.0], [1.0]])
    before, after = doors[:, 0] - 0.8, doors[:, 0] + 0.8
    way: list[tuple[float, float]] = [(middles[0] - rng.uniform(0.3, 0.5) * room[0], 0.0)]
    for index, middle in enumerate(middles):
        way.append((middle + rng.uniform(-0.2, 0.2), side[0, index]))
        if index < len(doors):
            way += [(before[index], doors[index, 1]), (after[index], doors[index, 1])]
    way.append((middles[-1] + rng.uniform(0.3, 0.5) * room[0], 0.0))
    for index in reversed(range(len(middles))):
        way.append((middles[index] + rng.uniform(-0.2, 0.2), side[1, index]))
        if index:
            way += [(after[index - 1], doors[index - 1, 1]), (before[index - 1], doors[index - 1, 1])]
    return np.array([[x, height, z] for x, z in way])


def _partition(house: np.ndarray, x: float, z: float) -> list[np.ndarray]:
    """The PIECES boxes of a wall across x with a door at z, from the walls to the door's sides and above it."""
    half_width, height = _DOOR
    top = house[1] - height
    pieces = []
    for low, high, bottom in (
        (-house[2] - _BEYOND, z - half_width, house[1] + _BEYOND),
        (z + half_width, house[2] + _BEYOND, house[1] + _BEYOND),
        (z - half_width, z + half_width, top),
    ):
        ceiling = -house[1] - _BEYOND
        centre = [x, (ceiling + bottom) / 2, (low + high) / 2]
        pieces.append(np.array([*centre, _HALF_WALL, (bottom - ceiling) / 2, (high - low) / 2, 0.0]))
    return pieces


def _moved(things: list[np.ndarray | None], x: float) -> list[np.ndarray]:
    """Those that found a place, moved along x."""
    return [thing + np.array([x, *[0.0] * (len(thing) - 1)]) for thing in things if thing is not None]


def _clutter_kind(index: int) -> str:
    return ("box", "sphere", "box", "cylinder")[index % 4]


def _place_small_box(rng: np.random.Generator, room: np.ndarray, path: np.ndarray) -> np.ndarray | None:
    """A shelf, a case or a crate with its back to a wall, as `_place_box` gives it."""
    for _ in range(_ATTEMPTS):
        half = np.array([rng.uniform(0.1, 0.5), rng.uniform(0.05, 0.9) * room[1], rng.uniform(0.08, 0.2)])
        along, across = (0, 2) if rng.random() < 0.5 else (2, 0)
        centre = np.array([0.0, room[1] - half[1], 0.0])
        centre[along] = rng.uniform(-1, 1) * (room[along] - half[0])
        # A little into the wall: faces that coincide would have to share their pixels.
        centre[across] = rng.choice([-1, 1]) * (room[across] - half[2] + 0.02)
        yaw = 0.0 if along == 0 else np.pi / 2
        if _box_distance(path, centre, half, yaw).min() > CLEARANCE:
            return np.concatenate([centre, half, [yaw]])
    return None


def _place_small_sphere(rng: np.random.Generator, room: np.ndarray, path: np.ndarray) -> np.ndarray | None:
    """A ball on the floor, as `_place_sphere` gives it."""
    for _ in range(_ATTEMPTS):
        radius = rng.uniform(0.06, 0.18)
        x, z = rng.uniform(-1, 1, 2) * (room[[0, 2]] - radius)
        centre = np.array([x, room[1] - radius, z])
        if _sphere_distance(path, centre, radius).min() > CLEARANCE:
            return np.array([*centre, radius])
    return None


def _place_small_cylinder(rng: np.random.Generator, room: np.ndarray, path: np.ndarray) -> np.ndarray | None:
    """A vase or a bin on the floor, as `_place_cylinder` gives it."""
    for _ in range(_ATTEMPTS):
        radius, half_height = rng.uniform(0.05, 0.15), rng.uniform(0.08, 0.35)
        x, z = rng.uniform(-1, 1, 2) * (room[[0, 2]] - radius)
        centre = np.array([x, room[1] - half_height, z])
        if _cylinder_distance(path, centre, radius, half_height).min() > CLEARANCE:
            return np.array([*centre, radius, half_height])
    return None


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
