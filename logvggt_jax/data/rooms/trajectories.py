"""Smooth closed camera paths through a room, through the doors of several, and several times round."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

HARMONICS = 2
_TABLE = 1024  # points of a walk
_ROUNDING = 0.35  # metres of a walk over which its corners are rounded, to either side
_LOOK_AHEAD = 1.2  # metres of a walk over which its direction is averaged, to either side
_DRIFT = (0.06, 0.03, 0.06)  # metres (x, y, z) by which laps of one path differ at most
_GAZE = np.deg2rad(30.0)  # yaw by which they differ at most


class CameraPath(Protocol):
    """A closed camera path in a phase of period 2 pi.

    The world is OpenCV-like: x right, y down, z forward, metres, origin in the middle of the room.
    """

    def positions(self, phases: np.ndarray) -> np.ndarray:
        """Camera positions [N, 3] at phases [N] in radians."""
        ...

    def angles(self, phases: np.ndarray) -> np.ndarray:
        """Yaw, pitch and roll [3, N] in radians at phases [N]."""
        ...

    def facing_north(self) -> CameraPath:
        """The same path, looking about the wall at +z: the yaw swings by 60 degrees to either side."""
        ...


def extrinsics(path: CameraPath, phases: np.ndarray) -> np.ndarray:
    """World-to-camera matrices [N, 4, 4] float64 (OpenCV) of `path` at phases [N] in radians."""
    yaw, pitch, roll = path.angles(phases)
    camera_to_world = _rotation(yaw, 2, 0) @ _rotation(pitch, 1, 2) @ _rotation(roll, 0, 1)
    rotation = camera_to_world.transpose(0, 2, 1)
    pose = np.tile(np.eye(4), (len(phases), 1, 1))
    pose[:, :3, :3] = rotation
    pose[:, :3, 3] = -(rotation @ path.positions(phases)[:, :, None])[..., 0]
    return pose


@dataclass(frozen=True)
class Trajectory:
    """A closed camera path: position, yaw, pitch and roll as sums of harmonics of one phase."""

    centre: np.ndarray  # [3] float64 mean position
    amplitude: np.ndarray  # [3, HARMONICS] float64 metres
    phase: np.ndarray  # [3, HARMONICS] float64 radians
    heading: float  # yaw at phase 0, radians
    turns: int  # full turns of the yaw in one period: -1, 0 or 1
    swing: np.ndarray  # [3, 2] float64, amplitude and phase in radians of the harmonic part of yaw, pitch and roll

    def facing_north(self) -> Trajectory:
        """As of `CameraPath`."""
        return replace(self, heading=0.0, turns=0, swing=_north(self.swing))

    def positions(self, phases: np.ndarray) -> np.ndarray:
        """As of `CameraPath`."""
        orders = np.arange(1, HARMONICS + 1)
        waves = np.sin(phases[:, None, None] * orders + self.phase)
        return self.centre + (self.amplitude * waves).sum(-1)

    def angles(self, phases: np.ndarray) -> np.ndarray:
        """As of `CameraPath`."""
        yaw, pitch, roll = _swings(self.swing, phases)
        return np.stack([yaw + self.heading + self.turns * phases, pitch, roll])


@dataclass(frozen=True)
class Walk:
    """A closed path along corners, rounded, at one pace, looking ahead."""

    places: np.ndarray  # [_TABLE + 1, 3] float64 metres, the first again at the end
    directions: np.ndarray  # [_TABLE + 1] float64 yaw in radians, without jumps
    swing: np.ndarray  # as of `Trajectory`
    ahead: bool = True  # whether the camera looks where it goes; else about the wall at +z

    def facing_north(self) -> Walk:
        """As of `CameraPath`."""
        return replace(self, ahead=False, swing=_north(self.swing))

    def positions(self, phases: np.ndarray) -> np.ndarray:
        """As of `CameraPath`."""
        return np.stack([self._look_up(phases, axis) for axis in self.places.T], axis=1)

    def angles(self, phases: np.ndarray) -> np.ndarray:
        """As of `CameraPath`."""
        yaw, pitch, roll = _swings(self.swing, phases)
        return np.stack([yaw + self._look_up(phases, self.directions) if self.ahead else yaw, pitch, roll])

    def _look_up(self, phases: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.interp(phases % (2.0 * np.pi), np.linspace(0.0, 2.0 * np.pi, len(values)), values)


@dataclass(frozen=True)
class Laps:
    """A path walked several times, each time a little aside and looking elsewhere; closed after the last."""

    path: CameraPath
    count: int
    drift: np.ndarray  # [4, 2] float64, amplitude (metres, radians) and phase of what x, y, z and yaw differ by

    def facing_north(self) -> Laps:
        """As of `CameraPath`."""
        return replace(self, path=self.path.facing_north())

    def positions(self, phases: np.ndarray) -> np.ndarray:
        """As of `CameraPath`, of period 2 pi `count`."""
        return self.path.positions(phases) + self._drifts(phases)[:3].T

    def angles(self, phases: np.ndarray) -> np.ndarray:
        """As of `CameraPath`, of period 2 pi `count`."""
        angles = self.path.angles(phases)
        angles[0] += self._drifts(phases)[3]
        return angles

    def _drifts(self, phases: np.ndarray) -> np.ndarray:
        amplitude, phase = self.drift[:, :1], self.drift[:, 1:]
        return amplitude * np.sin(phases / self.count + phase)


def random_trajectory(rng: np.random.Generator, half_size: np.ndarray) -> Trajectory:
    """A random path in a room of half extents `half_size` [3] (x, y, z): an ellipse-like loop with wobble.

    Half of the paths turn all the way round in one period, the others swing by 17 to 60 degrees to either side.
    """
    turns = int(rng.choice([-1, 1])) if rng.random() < 0.5 else 0
    amplitude = np.empty((3, HARMONICS))
    amplitude[(0, 2), 0] = rng.uniform(0.18, 0.42, 2) * half_size[[0, 2]]
    amplitude[1, 0] = rng.uniform(0.02, 0.12)
    amplitude[:, 1] = np.array([0.06, 0.03, 0.06]) * half_size * rng.uniform(0.0, 1.0, 3)
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, HARMONICS))
    # A quarter period between x and z makes the path a loop rather than a line run to and fro.
    phase[2, 0] = phase[0, 0] + rng.choice([-1, 1]) * np.pi / 2 + rng.uniform(-0.6, 0.6)
    centre = rng.uniform(-0.12, 0.12, 3) * half_size
    yaw_swing = rng.uniform(0.0, 10.0) if turns else rng.uniform(17.0, 60.0)
    swing = np.deg2rad([yaw_swing, rng.uniform(2.0, 12.0), rng.uniform(0.0, 4.0)])
    swing_phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    return Trajectory(
        centre=centre,
        amplitude=amplitude,
        phase=phase,
        heading=float(rng.uniform(0.0, 2.0 * np.pi)),
        turns=turns,
        swing=np.stack([swing, swing_phase], axis=1),
    )


def random_walk(rng: np.random.Generator, corners: np.ndarray) -> Walk:
    """A walk along `corners` [N, 3] and back to the first, starting anywhere on it and in either direction."""
    if rng.random() < 0.5:
        corners = corners[::-1]
    closed = np.concatenate([corners, corners[:1]])
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = (np.arange(_TABLE) / _TABLE + rng.random()) % 1.0 * lengths[-1]
    step = lengths[-1] / _TABLE
    places = np.stack([np.interp(at, lengths, axis) for axis in closed.T], axis=1)
    for _ in range(2):
        places = _mean_around(places, _ROUNDING / step)
    ahead = _mean_around(np.roll(places, -1, axis=0) - np.roll(places, 1, axis=0), _LOOK_AHEAD / step)
    directions = np.arctan2(ahead[:, 0], ahead[:, 2])
    swing = np.deg2rad([rng.uniform(5.0, 30.0), rng.uniform(2.0, 12.0), rng.uniform(0.0, 4.0)])
    return Walk(
        places=np.concatenate([places, places[:1]]),
        directions=np.unwrap(np.concatenate([directions, directions[:1]])),
        swing=np.stack([swing, rng.uniform(0.0, 2.0 * np.pi, 3)], axis=1),
    )


def random_laps(rng: np.random.Generator, path: CameraPath, count: int) -> Laps:
    """`path`, `count` times round with random differences: 6 cm and 30 degrees at most."""
    amplitude = np.array([*_DRIFT, _GAZE]) * rng.uniform(0.3, 1.0, 4)
    return Laps(path, count, np.stack([amplitude, rng.uniform(0.0, 2.0 * np.pi, 4)], axis=1))


def _mean_around(values: np.ndarray, reach: float) -> np.ndarray:
    """Means of `values` [N, D], which repeat after N, over `reach` neighbours to either side."""
    reach = int(reach)
    sums = np.cumsum(np.concatenate([np.zeros_like(values[:1]), values, values[: 2 * reach]]), axis=0)
    width = 2 * reach + 1
    return np.roll((sums[width:] - sums[:-width]) / width, reach, axis=0)


def _north(swing: np.ndarray) -> np.ndarray:
    swing = swing.copy()
    swing[0, 0] = np.deg2rad(60.0)
    return swing


def _swings(swing: np.ndarray, phases: np.ndarray) -> np.ndarray:
    amplitude, phase = swing[:, 0], swing[:, 1]
    return (amplitude * np.sin(phases[:, None] + phase)).T


def _rotation(angle: np.ndarray, first: int, second: int) -> np.ndarray:
    """[N, 3, 3] that turn axis `first` towards axis `second`."""
    matrix = np.tile(np.eye(3), (len(angle), 1, 1))
    cosine, sine = np.cos(angle), np.sin(angle)
    matrix[:, first, first] = matrix[:, second, second] = cosine
    matrix[:, first, second], matrix[:, second, first] = -sine, sine
    return matrix
