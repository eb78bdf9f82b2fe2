"""Camera poses at times, for sets whose pictures and poses have clocks of their own."""

import cv2
import numpy as np

from logvggt_jax.geometry import invert

# Milliseconds within which a pose counts as the picture's own: what rounding both times can differ by.
_SAME_TIME = 1


class PoseTrack:
    """World-to-camera poses with times in whole milliseconds; between them, centre and rotation are interpolated."""

    def __init__(self, times: np.ndarray, extrinsics: np.ndarray) -> None:
        """Args: `times` integer [N] in any order (of equal ones the first counts), N >= 1; `extrinsics` [N, 4, 4]
        float64, rigid, or not finite where tracking was lost."""
        self._times, first = np.unique(times, return_index=True)
        self._extrinsics = extrinsics[first]

    def at(self, time: int) -> np.ndarray | None:
        """World-to-camera [4, 4] at `time`: the pose within 1 ms, otherwise between its two neighbours.

        The camera's centre moves on a line and its rotation along the shortest arc, both at constant speed. None
        outside the times of the track, and where tracking was lost at a pose that this one needs.
        """
        after = int(np.searchsorted(self._times, time))
        nearest = min(
            (i for i in (after - 1, after) if 0 <= i < len(self._times)), key=lambda i: self._distance(i, time)
        )
        if self._distance(nearest, time) <= _SAME_TIME:
            pose = self._extrinsics[nearest]
            return pose if np.isfinite(pose).all() else None
        if not 0 < after < len(self._times):
            return None
        neighbours = self._extrinsics[after - 1 : after + 1]
        if not np.isfinite(neighbours).all():
            return None
        earlier, later = (invert(pose) for pose in neighbours)
        share = (time - self._times[after - 1]) / (self._times[after] - self._times[after - 1])
        turn, _ = cv2.Rodrigues(earlier[:3, :3].T @ later[:3, :3])
        pose = np.eye(4)
        pose[:3, :3] = earlier[:3, :3] @ cv2.Rodrigues(share * turn)[0]
        pose[:3, 3] = (1 - share) * earlier[:3, 3] + share * later[:3, 3]
        return invert(pose)

    def _distance(self, index: int, time: int) -> int:
        return abs(int(self._times[index]) - time)
