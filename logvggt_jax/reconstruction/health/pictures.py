"""How small pictures of frames fit one another by themselves, whatever depth and cameras say."""

from __future__ import annotations

import warnings

import numpy as np

# Pairs of frames worked on at a time.
_BLOCK = 512
# Two pictures show the same where, on one another, they correlate by so much and have at least this share in common.
_ALIKE, _LEAST_SHARE = 0.8, 0.3
# Of pictures that share less than this nobody can say what has moved in them.
_ENOUGH = 0.6
# What moves on its own is farther from its place than so many cells, and differs by so much of the contrast from all
# that is nearer. Contrast is that of the logarithm of the grey level, with so much light added; it is at least so much.
_REACH, _OTHER, _LIGHT, _LEAST_CONTRAST = 2, 0.5, 8.0, 0.05


def picture_changes(grey: np.ndarray) -> np.ndarray:
    """[N] of small pictures [N, r, c]: one minus the correlation of each with the one before; NaN where one is flat."""
    flat = grey.reshape(len(grey), -1).astype(np.float64)
    flat -= flat.mean(1, keepdims=True)
    lengths = np.linalg.norm(flat, axis=1)
    changes = np.full(len(grey), np.nan)
    product = lengths[1:] * lengths[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        changes[1:] = np.where(product > 0, 1 - (flat[1:] * flat[:-1]).sum(1) / product, np.nan)
    return changes


def compare_pictures(grey: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[n, 2] of the pairs of frames `first` [n] and `second` [n] among small pictures [N, r, c]:

    - the share of the picture that both show, by the shift at which they are most alike; NaN where they are not alike.
    - the share of that which differs from all that the other shows within two cells of its place, whatever the light:
      the larger of both directions; NaN where they share too little.
    """
    halved = _halved(grey.astype(np.float64))
    light = np.log(grey + _LIGHT)
    found = [np.zeros((0, 2))]
    for start in range(0, len(first), _BLOCK):
        ones, others = first[start : start + _BLOCK], second[start : start + _BLOCK]
        alike, share, shift = _best_shifts(halved[ones], halved[others])
        one, other = light[ones], light[others]
        elsewhere = np.fmax(
            _unmatched(one, _moved(other, 2 * shift)),
            _unmatched(other, _moved(one, -2 * shift)),
        )
        shared = np.where(alike >= _ALIKE, share, np.nan)
        found.append(np.stack([shared, np.where(share >= _ENOUGH, elsewhere, np.nan)], axis=1))
    return np.concatenate(found)


def _halved(pictures: np.ndarray) -> np.ndarray:
    """Means over two by two cells."""
    rows, columns = (length // 2 * 2 for length in pictures.shape[1:])
    even = pictures[:, :rows, :columns]
    return (even[:, ::2, ::2] + even[:, 1::2, ::2] + even[:, ::2, 1::2] + even[:, 1::2, 1::2]) / 4


def _best_shifts(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of pairs of pictures [n, r, c]: highest correlation, shared share, and shift [n, 2] from the other to the one."""
    count, rows, columns = one.shape
    down, right = np.arange(1 - rows, rows), np.arange(1 - columns, columns)
    cells = (rows - np.abs(down))[:, None] * (columns - np.abs(right))
    one, other = (each - each.mean((1, 2), keepdims=True) for each in (one, other))
    double = (2 * rows, 2 * columns)
    spectrum = np.fft.rfft2(one, double) * np.fft.rfft2(other, double).conj()
    products = np.fft.irfft2(spectrum, double)[:, down[:, None], right]
    sums, sums_there = _sums(one, down, right), _sums(other, -down, -right)
    spread = _sums(one**2, down, right) - sums**2 / cells
    spread_there = _sums(other**2, -down, -right) - sums_there**2 / cells
    compared = (cells >= _LEAST_SHARE * rows * columns) & (np.minimum(spread, spread_there) > 1e-3 * cells)
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = (products - sums * sums_there / cells) / np.sqrt(spread * spread_there)
    alike = np.where(compared, alike, -np.inf).reshape(count, -1)
    best = alike.argmax(1)
    highest = alike[np.arange(count), best]
    shares = (cells / (rows * columns)).ravel()[best]
    shifts = np.stack([down[best // len(right)], right[best % len(right)]], axis=1)
    flat = ~np.isfinite(highest)
    shifts[flat] = 0
    return np.where(flat, np.nan, highest), np.where(flat, np.nan, shares), shifts


def _sums(pictures: np.ndarray, down: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Of each of [n, r, c], for all shifts [n, d, e]: the sum over what lies on a picture moved by the shift."""
    rows, columns = pictures.shape[1:]
    whole = np.pad(pictures.cumsum(1).cumsum(2), ((0, 0), (1, 0), (1, 0)))
    top, bottom = np.maximum(0, down), rows + np.minimum(0, down)
    left, end = np.maximum(0, right), columns + np.minimum(0, right)
    upper, lower = whole[:, top], whole[:, bottom]
    sums: np.ndarray = lower[:, :, end] - lower[:, :, left] - upper[:, :, end] + upper[:, :, left]
    return sums


def _moved(pictures: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Each of [n, r, c] moved down and right by its own shift [n, 2]; NaN where nothing comes from."""
    count, rows, columns = pictures.shape
    row, column = np.arange(rows) - shift[:, :1], np.arange(columns) - shift[:, 1:]
    inside = ((row >= 0) & (row < rows))[:, :, None] & ((column >= 0) & (column < columns))[:, None, :]
    taken = pictures[
        np.arange(count)[:, None, None], row.clip(0, rows - 1)[:, :, None], column.clip(0, columns - 1)[:, None, :]
    ]
    return np.where(inside, taken, np.nan)


def _unmatched(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[n]: share of what lies well within `other`, NaN elsewhere, that is unlike all that lies around its place."""
    shared = np.isfinite(other)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN|Degrees of freedom", RuntimeWarning)
        there = np.where(shared, one, np.nan)
        contrast = np.maximum(np.nanstd(there, (1, 2), keepdims=True), _LEAST_CONTRAST)
        lit = other + np.nanmedian(there - other, (1, 2), keepdims=True)  # in the same light
    low, high = (_around(lit, choose) for choose in (np.minimum, np.maximum))
    judged = np.isfinite(low)
    with np.errstate(invalid="ignore"):
        unlike = np.maximum(low - one, one - high) > _OTHER * contrast
        return (unlike & judged).sum((1, 2)) / judged.sum((1, 2))


def _around(pictures: np.ndarray, choose: np.ufunc) -> np.ndarray:
    """What `choose` takes of each cell of [n, r, c] and those within reach; NaN where one of them is not known."""
    for axis in (1, 2):
        width = [(0, 0)] * 3
        width[axis] = (_REACH, _REACH)
        padded, length = np.pad(pictures, width, constant_values=np.nan), pictures.shape[axis]
        pictures = choose.reduce([np.take(padded, range(i, i + length), axis) for i in range(2 * _REACH + 1)])
    return pictures
