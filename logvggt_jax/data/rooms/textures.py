"""Textures as small tables that the ray casters look up, and normals beside them."""

from dataclasses import dataclass

import numpy as np

WAVES = 6  # sine waves of a texture: four of smooth noise, two whose product is a checker or stripe pattern
PIECES = 3  # boxes of a partition: beside its door on either side, and above it

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
    normal_slope: np.ndarray  # [3, S]; the normal that faces the viewer is normal_slope * p + normal_offset
    normal_offset: np.ndarray  # [3, S]


def random_textures(
    rng: np.random.Generator,
    box: np.ndarray,
    partitions: int,
    sphere: np.ndarray,
    cylinder: np.ndarray,
    *,
    compass: bool,
    repetition: float,
) -> Textures:
    """Textures of a room's faces, boxes [N, 7], spheres [N, 4] and cylinders [N, 5].

    The last `partitions` x PIECES boxes are walls across x, pieces of one after another; each side of such a wall has
    one texture. With `compass` walls, floor and ceiling have their own colours. A share `repetition` of the textures
    repeats exactly after one period of its pattern, as tiles and wallpaper do.
    """
    # Normals that face the viewer: into the room on its faces, outwards on furniture; NaN on curved surfaces.
    axes = np.concatenate([np.eye(3)[:, None] * -1, np.eye(3)[:, None]], axis=1).reshape(6, 3)
    normals = [-axes]
    for yaw in box[:, 6]:
        cosine, sine = np.cos(yaw), np.sin(yaw)
        normals.append(axes @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]]))
    normals.append(np.zeros((len(sphere) + 2 * len(cylinder), 3)))
    normal = np.concatenate(normals)
    count, first_curved = len(normal), 6 + 6 * len(box)
    # Which body a surface belongs to: one texture each.
    owners = [np.arange(6), 6 + np.arange(6 * (len(box) - PIECES * partitions)) // 6]
    bodies, of_house = 6 + len(box) - PIECES * partitions, [*range(6)]
    for _ in range(partitions):
        owners += [bodies + np.array([0, 1, 0, 0, 0, 0])] * PIECES
        of_house += [bodies, bodies + 1]
        bodies += 2
    owners += [bodies + np.arange(len(sphere)), bodies + len(sphere) + np.arange(2 * len(cylinder)) // 2]
    owner = np.concatenate(owners)
    bodies += len(sphere) + len(cylinder)
    of_room = np.isin(np.arange(bodies), of_house)

    base = rng.uniform(0.15, 0.95, (bodies, 3))
    if compass:
        # The side of a partition at -x is the wall +x of the room before it.
        faces = [*range(6), *[1, 0] * partitions]
        base[of_house] = _COMPASS_COLOURS[faces] + rng.uniform(-0.08, 0.08, (len(faces), 3))
    second = base * rng.uniform(0.35, 0.7, (bodies, 1)) + rng.uniform(-0.06, 0.06, (bodies, 3))
    finest = np.where(of_room, rng.uniform(0.35, 0.9, bodies), rng.uniform(0.14, 0.4, bodies))
    periods = np.concatenate([finest * rng.uniform(1.0, 4.0, (4, bodies)), np.tile(finest, (2, 1))])
    direction = rng.normal(size=(bodies, WAVES, 3))
    stripes = rng.random(bodies) < 0.35
    repeats = rng.random(bodies) < repetition if repetition else np.zeros(bodies, bool)

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
        if repeats[body]:
            # All waves on the lattice of the pattern's.
            waves[:4] = waves[4], waves[5], waves[4] + waves[5], waves[4] - waves[5]
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

    normal_slope, normal_offset = np.zeros((3, count)), normal.T.copy()
    for index, (centre, radius) in enumerate(zip(sphere[:, :3], sphere[:, 3], strict=True)):
        normal_slope[:, first_curved + index] = 1.0 / radius
        normal_offset[:, first_curved + index] = -centre / radius
    for index, (centre, radius, half_height) in enumerate(
        zip(cylinder[:, :3], cylinder[:, 3], cylinder[:, 4], strict=True)
    ):
        side = first_curved + len(sphere) + 2 * index
        normal_slope[(0, 2), side] = 1.0 / radius
        normal_offset[(0, 2), side] = -centre[[0, 2]] / radius
        # One surface for both caps: their normals are -1 and 1 along y.
        normal_slope[1, side + 1] = 1.0 / half_height
        normal_offset[1, side + 1] = -centre[1] / half_height

    colour = np.clip(np.stack([base, second]), 0.0, 1.0)[:, owner].transpose(0, 2, 1)
    tables = {
        "colour": colour,
        "frequency": frequency,
        "phase": phase,
        "pattern_weight": rng.uniform(0.3, 0.8, bodies)[owner],
        "edge": rng.uniform(0.05, 0.6, bodies)[owner],
        "pattern_frequency": 2.0 * np.pi / finest[owner],
        "shade": shade,
        "normal_slope": normal_slope,
        "normal_offset": normal_offset,
    }
    return Textures(**{name: np.ascontiguousarray(table, np.float32) for name, table in tables.items()})
