"""How frames fit one another: the points of one, seen from another's camera, on coarse depth maps."""

from __future__ import annotations

import numpy as np

from logvggt_jax.geometry import compose, invert

# Pairs of frames worked on at a time.
_BLOCK = 512
# Of fewer points nobody can say whether two pictures are alike.
_FEWEST_POINTS = 20


class Views:
    """Coarse depth maps, pictures and cameras of a sequence.

    Args:
      depth: [N, r, c] z-depth in the unit of the extrinsics, NaN where there is none.
      grey: [N, r, c] pictures of as many cells, their means.
      places: rows [r] and columns [c] of the pixels that it is known at.
      size: (H, W) of the images.
      extrinsics: [N, 3, 4] world-to-camera.
      intrinsics: [N, 3, 3] in pixels of the images.
    """

    def __init__(
        self,
        depth: np.ndarray,
        grey: np.ndarray,
        places: tuple[np.ndarray, np.ndarray],
        size: tuple[int, int],
        extrinsics: np.ndarray,
        intrinsics: np.ndarray,
    ) -> None:
        self._depth, self._places, self._size = depth, places, size
        self._extrinsics, self._intrinsics = extrinsics, intrinsics
        self._grey = grey
        self._down, self._right = (_at_cells(*each) for each in zip(places, size, strict=True))

    def compare(self, first: np.ndarray, second: np.ndarray, *, tolerance: float) -> np.ndarray:
        """[n, 4] of pairs of frames `first` [n] and `second` [n], NaN where a frame has no depth:

        - the share of one's points that the other's camera sees, the lower of both directions;
        - the median relative difference between the points' depth and that of the other, the larger of both;
        - the share of the points seen that lie in front of all that the other sees thereabouts, by more than
          `tolerance` of the depth: it should have seen them. The larger of both. What is hidden does not count.
        - the correlation of both pictures at the points seen, the larger of both; NaN where they are few or all alike.
        """
        found = [self._one_way(*pair, tolerance) for pair in _blocks(first, second)]
        back = [self._one_way(*pair, tolerance) for pair in _blocks(second, first)]
        there, again = np.concatenate(found), np.concatenate(back)
        lower, larger = np.fmin(there, again), np.fmax(there, again)
        return np.stack([lower[:, 0], larger[:, 1], larger[:, 2], larger[:, 3]], axis=1)

    def _one_way(self, source: np.ndarray, target: np.ndarray, tolerance: float) -> np.ndarray:
        rows, columns = self._places
        height, width = self._size
        depth, there = self._depth[source].astype(np.float64), self._depth[target].astype(np.float64)
        count = len(source)
        camera, other = self._intrinsics[source], self._intrinsics[target]
        x = (columns[None, None] - camera[:, 0, 2, None, None]) / camera[:, 0, 0, None, None] * depth
        y = (rows[None, :, None] - camera[:, 1, 2, None, None]) / camera[:, 1, 1, None, None] * depth
        moved = compose(self._extrinsics[target], invert(self._extrinsics[source]))
        points = np.stack([x, y, depth], axis=-1).reshape(count, -1, 3) @ np.swapaxes(moved[:, :3, :3], 1, 2)
        points += moved[:, None, :3, 3]
        z = points[..., 2]
        known = np.isfinite(z)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = points[..., 0] / z * other[:, 0, 0, None] + other[:, 0, 2, None]
            v = points[..., 1] / z * other[:, 1, 1, None] + other[:, 1, 2, None]
            inside = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
        seen = known & (z > 0) & inside
        column = np.interp(np.where(seen, u, 0), columns, np.arange(len(columns)))
        row = np.interp(np.where(seen, v, 0), rows, np.arange(len(rows)))
        with np.errstate(divide="ignore"):
            expected = 1 / _between(1 / there, row, column)  # inverse depth is linear on planes
        nearest = _nearest_around(there)[np.arange(count)[:, None], row.round().astype(int), column.round().astype(int)]
        compared = seen & np.isfinite(expected)
        with np.errstate(divide="ignore", invalid="ignore"):
            apart = np.where(compared, np.abs(np.log(z / expected)), np.nan)
            in_front = compared & (z < (1 - tolerance) * nearest)
            overlap = seen.sum(1) / known.sum(1)
            conflicts = in_front.sum(1) / compared.sum(1)
        # Where depth is known, which is from edge to edge.
        grey, grey_there = (self._down @ self._grey[frames] @ self._right.T for frames in (source, target))
        alike = _correlations(grey.reshape(count, -1), _between(grey_there, row, column), seen)
        return np.stack([overlap, medians(apart), conflicts, alike], axis=1)


def medians(values: np.ndarray) -> np.ndarray:
    """Medians [n] of the numbers in each row of [n, m]; NaN where a row has none."""
    ordered = np.sort(values, axis=1)  # NaN last
    count = np.isfinite(values).sum(1)
    each = np.arange(len(values))
    lower, upper = (
        ordered[each, np.maximum(count - 1, 0) // 2],
        ordered[each, np.minimum(count // 2, values.shape[1] - 1)],
    )
    return np.where(count > 0, (lower + upper) / 2, np.nan)


def _blocks(first: np.ndarray, second: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(first[i : i + _BLOCK], second[i : i + _BLOCK]) for i in range(0, len(first), _BLOCK)]


def _between(values: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Values [n, m] at places between the cells of [n, r, c]."""
    top = np.minimum(row.astype(int), values.shape[1] - 2)
    left = np.minimum(column.astype(int), values.shape[2] - 2)
    down, right = row - top, column - left
    frame = np.arange(len(values))[:, None]
    upper = (1 - right) * values[frame, top, left] + right * values[frame, top, left + 1]
    lower = (1 - right) * values[frame, top + 1, left] + right * values[frame, top + 1, left + 1]
    between: np.ndarray = (1 - down) * upper + down * lower
    return between


def _at_cells(places: np.ndarray, edge: int) -> np.ndarray:
    """[n, n]: what takes means over n cells of an edge of so many pixels to the pixels of `places` [n]."""
    count = len(places)
    cells = np.clip((places + 0.5) * count / edge - 0.5, 0, count - 1)
    return np.stack([np.interp(cells, np.arange(count), each) for each in np.eye(count)], axis=1)


def _correlations(first: np.ndarray, second: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """[n] of the rows of two [n, m], where `valid`; NaN where that is too seldom, or one is flat."""
    count = valid.sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (
            np.where(valid, each - (np.where(valid, each, 0).sum(1) / count)[:, None], 0) for each in (first, second)
        )
        product = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
        return np.where((count >= _FEWEST_POINTS) & (product > 0), (one * other).sum(1) / product, np.nan)


def _nearest_around(depth: np.ndarray) -> np.ndarray:
    """The least depth of each cell and those around it, [n, r, c]."""
    padded = np.pad(np.where(np.isfinite(depth), depth, np.inf), ((0, 0), (1, 1), (1, 1)), constant_values=np.inf)
    height, width = depth.shape[1:]
    shifted = [padded[:, i : i + height, j : j + width] for i in range(3) for j in range(3)]
    least: np.ndarray = np.min(shifted, axis=0)
    return least
