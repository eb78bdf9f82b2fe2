"""Which points of a cloud are shown: of any number a few, evenly over all, and always the same ones first."""

from __future__ import annotations

import numpy as np

from logvggt_jax.reconstruction.points.cloud_file import Cloud

# A browser turns so many smoothly; they are 15 bytes each on their way there.
MOST_SHOWN = 2_000_000
USUALLY_SHOWN = 500_000
_BLOCK = 1_000_000
# Choices of a number of points.
_MOST_LEVELS = 6


def levels_of_detail(count: int) -> list[int]:
    """How many of `count` points may be shown: all that a browser turns, then fewer, 1, 2 and 5 times 10, 100, …"""
    most = max(min(count, MOST_SHOWN), 1)
    round_numbers = [digit * 10**power for power in range(len(str(most))) for digit in (1, 2, 5)]
    return [most, *sorted((each for each in round_numbers if each < most), reverse=True)][:_MOST_LEVELS]


class Detail:
    """Chooses points of a cloud up to a number: the first ones of an order of chance that has room for them.

    What is shown at less detail is shown at more, too, and every part of the scene is thinned alike.

    Args:
      cloud: of any size.
    """

    def __init__(self, cloud: Cloud) -> None:
        self._cloud = cloud
        self._order = np.random.default_rng(0).permutation(len(cloud.points)).astype(np.int32)

    def choose(self, most: int, *, lowest: float = 0.0, frame: int | None = None) -> np.ndarray:
        """Indices [n] of at most `most` points.

        Args:
          most: the number.
          lowest: confidence below which points are left out; without effect where the cloud holds none.
          frame: only this frame's; without effect likewise.
        """
        if frame is None or self._cloud.frame is None:
            return self._first(self._order, most, lowest)
        start, stop = np.searchsorted(self._cloud.frame, [frame, frame + 1])
        return self._first(start + np.random.default_rng(frame).permutation(stop - start), most, lowest)

    def confidence_at(self, percent: float) -> float:
        """The confidence that this share of the points does not reach; 0 where the cloud holds none."""
        confidence = self._cloud.confidence
        if confidence is None or not len(confidence) or percent <= 0:
            return 0.0
        return float(np.percentile(confidence[self._order[:_BLOCK]], percent))

    def _first(self, order: np.ndarray, most: int, lowest: float) -> np.ndarray:
        confidence = self._cloud.confidence
        if confidence is None or lowest <= 0:
            return order[:most]
        found, missing = [order[:0]], most
        for start in range(0, len(order), _BLOCK):
            part = order[start : start + _BLOCK]
            found.append(part[confidence[part] >= lowest][:missing])
            missing -= len(found[-1])
            if not missing:
                break
        return np.concatenate(found)
