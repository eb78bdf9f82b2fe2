"""What is kept of every frame while a sequence streams, and the measures that come of it at the end."""

from __future__ import annotations

import threading
from collections.abc import Mapping

import numpy as np

from logvggt_jax.geometry import camera_centres, rotation_angle
from logvggt_jax.reconstruction.health.looks import NUMBERS, Look, look, places
from logvggt_jax.reconstruction.health.measures import CONFLICTS_APART, Measures
from logvggt_jax.reconstruction.health.neighbours import Views
from logvggt_jax.reconstruction.health.pictures import compare_pictures, picture_changes
from logvggt_jax.streaming import Signals

# Relative differences of depth that are no conflict: at least, and as a multiple of those between neighbours.
_TOLERANCE, _TIMES = 0.1, 4.0


class HealthRecorder:
    """Sees every frame once, in any order and by several threads; keeps 1.8 kB of each."""

    def __init__(self) -> None:
        self._looks: dict[int, Look] = {}
        self._lock = threading.Lock()

    def see(self, frame: int, depth: np.ndarray, confidence: np.ndarray, image: np.ndarray) -> None:
        """Looks at a frame: depth and confidence [H, W], image [H, W, 3] uint8 RGB."""
        found = look(image, depth, confidence)
        with self._lock:
            self._looks[frame] = found

    def arrays(self) -> dict[str, np.ndarray]:
        """All that was seen, for `restore`."""
        frames = sorted(self._looks)
        if not frames:
            return {}
        looks = [self._looks[frame] for frame in frames]
        stacked = {name: np.stack([getattr(each, name) for each in looks]) for name in Look._fields}
        return {"frames": np.array(frames, np.int64), **stacked}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes up what `arrays` gave."""
        for place, frame in enumerate(arrays.get("frames", np.zeros(0)).tolist()):
            self._looks[frame] = Look(*(arrays[name][place] for name in Look._fields))

    def measures(
        self,
        *,
        size: tuple[int, int],
        extrinsics: np.ndarray,
        intrinsics: np.ndarray,
        depth_scale: np.ndarray,
        field_of_view: np.ndarray,
        signals: Signals,
    ) -> Measures:
        """The measures of the N frames of a finished sequence.

        Args:
          size: (H, W) of the images that were seen.
          extrinsics: [N, 3, 4] world-to-camera.
          intrinsics: [N, 3, 3] in pixels of these images.
          depth_scale: [N], by which the depth that was seen is multiplied to fit the extrinsics.
          field_of_view: [N] horizontal, radians, as the model predicts it.
          signals: of the N frames.
        """
        count, where = len(extrinsics), places(size)
        numbers = np.full((count, len(NUMBERS)), np.nan)
        depth = np.full((count, len(where[0]), len(where[1])), np.nan, np.float32)
        grey = np.zeros(depth.shape, np.uint8)
        for frame, found in self._looks.items():
            numbers[frame] = found.numbers
            depth[frame] = found.depth * np.float32(depth_scale[frame])
            grey[frame] = found.grey
        arrays = dict(zip(NUMBERS, numbers.T, strict=True))
        median_depth = arrays.pop("median_depth") * depth_scale
        views = Views(depth, grey, where, size, np.asarray(extrinsics, np.float64), np.asarray(intrinsics, np.float64))
        later = np.arange(1, count)
        beside = np.full((count, 4), np.nan)
        conflicts, step, turn, shared, elsewhere = np.full((5, count), np.nan)
        if count > 1:
            earlier = np.maximum(later - CONFLICTS_APART, 0)
            shared[1:] = compare_pictures(grey, later - 1, later)[:, 0]
            elsewhere[1:] = compare_pictures(grey, earlier, later)[:, 1]
            beside[1:] = views.compare(later - 1, later, tolerance=_TOLERANCE)
            known = beside[np.isfinite(beside[:, 1]), 1]
            tolerance = max(_TOLERANCE, min(0.5, _TIMES * float(np.median(known)))) if len(known) else _TOLERANCE
            conflicts[1:] = views.compare(earlier, later, tolerance=tolerance)[:, 2]
            step[1:] = np.linalg.norm(np.diff(camera_centres(extrinsics), axis=0), axis=1) / median_depth[:-1]
            turn[1:] = np.degrees(rotation_angle(extrinsics[:-1, :3, :3], extrinsics[1:, :3, :3]))
        return Measures.of(
            {
                **arrays,
                "picture_change": picture_changes(grey),
                "field_of_view": np.degrees(field_of_view),
                "step": step,
                "turn": turn,
                "overlap": beside[:, 0],
                "disagreement": beside[:, 1],
                "conflicts": conflicts,
                "shared_picture": shared,
                "elsewhere": elsewhere,
                "likeness": beside[:, 3],
                **signals._asdict(),
            },
            count,
        )
