"""How much each frame's depth has to grow to agree with given cameras and with its neighbours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from logvggt_jax.geometry import points_at, project
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.result import Reconstruction

# Neighbours whose depth is compared: so many frames apart.
_APART = (1, 2, 4, 8, 16, 32)
# Pixels of a frame that are compared, about.
_PIXELS = 1500
_FEWEST = 30
_ROUNDS = 15
# How far two depths may differ, as logarithm, and still be of one surface; from the first to the last round.
_GATES = (0.5, 0.1)
# The weight of the common scale beside that of a neighbour's depth: it decides where neighbours say nothing.
_COMMON = 0.001


class DepthScales(NamedTuple):
    """Scales of depth.

    Attributes:
      scales: [N] float64.
      before, after: median over pairs of neighbours by how much their depth differs, a share; with the cameras' own
        scale for all, and with these. NaN where no two frames see the same.
    """

    scales: np.ndarray
    before: float
    after: float


class _Sample(NamedTuple):
    """Some pixels of a frame: a coarse depth map [h, w] of every n-th pixel, and its pixels [h * w, 2] (u, v)."""

    depth: np.ndarray
    pixels: np.ndarray
    step: int


def depth_scales(
    result: Reconstruction, frames: Sequence[int], extrinsics: np.ndarray, intrinsics: np.ndarray, scale: float
) -> DepthScales:
    """Scales of the depth of some frames under other cameras.

    They are on average that of the world, and agree with their neighbours': the median of the ratio of their depth
    where they see the same surface is made one, in least squares over all pairs with robust weights.

    Args:
      result: of the depth.
      frames: [n] numbers of the frames.
      extrinsics: [n, 3|4, 4] world-to-camera, the new cameras of these frames.
      intrinsics: [n, 3, 3] in pixels of the depth maps.
      scale: of the new world to the result's.
    """
    with FramePool() as pool:
        samples = list(pool.map(lambda index: _sample(result, index), iter(frames)))
    count = len(frames)
    pairs = [(i, j) for apart in _APART for i in range(count - apart) for j in (i + apart,)]
    pairs += [(j, i) for i, j in pairs]
    common = logarithms = np.full(count, np.log(scale))
    before = _disagreement(_ratios(samples, extrinsics, intrinsics, common, pairs, _GATES[0]))
    after = float("nan")
    for gate in np.geomspace(*_GATES, _ROUNDS):
        found = list(_ratios(samples, extrinsics, intrinsics, logarithms, pairs, gate))
        if not found:
            break
        logarithms = _solve(found, logarithms, common)
        after = _disagreement(iter(found))
    return DepthScales(np.exp(logarithms), before, after)


def _sample(result: Reconstruction, index: int) -> _Sample:
    depth = result.depth(index)
    step = max(1, round(np.sqrt(depth.size / _PIXELS)))
    first = step // 2
    coarse = depth[first::step, first::step]
    v, u = np.mgrid[: coarse.shape[0], : coarse.shape[1]] * step + first
    return _Sample(coarse, np.stack([u, v], -1).reshape(-1, 2), step)


def _ratios(
    samples: Sequence[_Sample],
    extrinsics: np.ndarray,
    intrinsics: np.ndarray,
    logarithms: np.ndarray,
    pairs: Sequence[tuple[int, int]],
    gate: float,
) -> Iterator[tuple[int, int, float]]:
    """For pairs of frames that see the same: by how much, as logarithm, the second's depth exceeds the first's."""
    scales = np.exp(logarithms)
    points = []
    for index, sample in enumerate(samples):
        depth = scales[index] * sample.depth.reshape(-1).astype(np.float64)
        valid = np.isfinite(depth) & (depth > 0)
        points.append(points_at(sample.pixels[valid], depth[valid], intrinsics[index], extrinsics[index]))
    for i, j in pairs:
        pixels, depth = project(points[i], intrinsics[j], extrinsics[j])
        other = samples[j]
        with np.errstate(invalid="ignore"):
            places = np.rint((pixels - other.step // 2) / other.step)
            inside = (depth > 0) & ((places >= 0) & (places < other.depth.shape[::-1])).all(-1)
        u, v = places[inside].astype(int).T
        seen = scales[j] * other.depth[v, u]
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(seen / depth[inside])
        logs = logs[np.abs(logs) < gate]
        if len(logs) >= _FEWEST:
            yield i, j, float(np.median(logs))


def _solve(found: Sequence[tuple[int, int, float]], logarithms: np.ndarray, common: np.ndarray) -> np.ndarray:
    """Logarithms of scales [n] that agree best: the first's grows by what the second's depth is larger."""
    first, second, excess = (np.array(values) for values in zip(*found, strict=True))
    weights = 1 / np.maximum(np.abs(excess), max(1.5 * float(np.median(np.abs(excess))), 1e-6))
    weights /= weights.max()
    wanted = logarithms[first] - logarithms[second] + excess
    count = len(logarithms)
    matrix = coo_array(
        (
            np.concatenate([weights, weights, -weights, -weights, np.full(count, _COMMON)]),
            (
                np.concatenate([first, second, first, second, np.arange(count)]),
                np.concatenate([first, second, second, first, np.arange(count)]),
            ),
        ),
        shape=(count, count),
    )
    side = _COMMON * common
    np.add.at(side, first, weights * wanted)
    np.add.at(side, second, -weights * wanted)
    return np.atleast_1d(spsolve(matrix.tocsc(), side))


def _disagreement(found: Iterator[tuple[int, int, float]]) -> float:
    values = [abs(excess) for _, _, excess in found]
    return float(np.expm1(np.median(values))) if values else float("nan")
