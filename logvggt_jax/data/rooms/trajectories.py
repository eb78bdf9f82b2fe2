"""Smooth closed camera paths through a room."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

HARMONICS = 2


@dataclass(frozen=True)
class Trajectory:
    """A closed camera path: position, yaw, pitch and roll as sums of harmonics of one phase.

    The world is OpenCV-like: x right, y down, z forward, metres, origin in the middle of the room.
    """

    centre: np.ndarray  # [3] float64 mean position
    amplitude: np.ndarray  # [3, HARMONICS] float64 metres
    phase: np.ndarray  # [3, HARMONICS] float64 radians
    heading: float  # yaw at phase 0, radians
    turns: int  # full turns of the yaw in one period: -1, 0 or 1
    swing: np.ndarray  # [3, 2] float64, amplitude and phase in radians of the harmonic part of yaw, pitch and roll

    def facing_north(self) -> Trajectory:
        """The same path, looking about the wall at +z: the yaw swings by 60 degrees to either side."""
        swing = self.swing.copy()
        swing[0, 0] = np.deg2rad(60.0)
        return replace(self, heading=0.0, turns=0, swing=swing)

    def positions(self, phases: np.ndarray) -> np.ndarray:
        """Camera positions [N, 3] at phases [N] in radians."""
        orders = np.arange(1, HARMONICS + 1)
        waves = np.sin(phases[:, None, None] * orders + self.phase)
        return self.centre + (self.amplitude * waves).sum(-1)

    def extrinsics(self, phases: np.ndarray) -> np.ndarray:
        """World-to-camera matrices [N, 4, 4] float64 (OpenCV) at phases [N] in radians."""
        amplitude, phase = self.swing[:, 0], self.swing[:, 1]
        yaw, pitch, roll = (amplitude * np.sin(phases[:, None] + phase)).T
        yaw = yaw + self.heading + self.turns * phases
        camera_to_world = _rotation(yaw, 2, 0) @ _rotation(pitch, 1, 2) @ _rotation(roll, 0, 1)
        rotation = camera_to_world.transpose(0, 2, 1)
        pose = np.tile(np.eye(4), (len(phases), 1, 1))
        pose[:, :3, :3] = rotation
        pose[:, :3, 3] = -(rotation @ self.positions(phases)[:, :, None])[..., 0]
        return pose


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


def _rotation(angle: np.ndarray, first: int, second: int) -> np.ndarray:
    """[N, 3, 3] that turn axis `first` towards axis `second`."""
    matrix = np.tile(np.eye(3), (len(angle), 1, 1))
    cosine, sine = np.cos(angle), np.sin(angle)
    matrix[:, first, first] = matrix[:, second, second] = cosine
    matrix[:, first, second], matrix[:, second, first] = -sine, sine
    return matrix
