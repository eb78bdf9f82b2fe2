"""Video depth: alignment of a clip's depth to the ground truth, and the field's error measures.

Source: the evaluation code of CUT3R and its descendants (`eval/video_depth/tools.py`), in float64.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from logvggt_jax.evaluation.progress import track
from logvggt_jax.evaluation.scratch import scratch_array

ALIGNMENTS = ("metric", "scale", "median", "lstsq", "scale_shift")
DEPTH_KEYS = ("abs_rel", "sq_rel", "rmse", "log_rmse", "delta_1.25", "delta_1.25^2", "delta_1.25^3")

_SMALLEST_DEPTH = 1e-5
_SMALLEST_SCALE = 1e-3
_BLOCK = 2**20  # pixels


def depth_metrics(
    prediction: np.ndarray,
    target: np.ndarray,
    *,
    alignment: str,
    max_depth: float | None = None,
    clip: float | None = None,
    mask: np.ndarray | None = None,
) -> dict[str, float]:
    """Errors of predicted z-depth, aligned and pooled over all pixels of a clip.

    Args:
      prediction: [..., H, W] depth of any unit; sizes that differ from the target's need `resize_depth`
        first.
      target: [..., H, W] true depth; pixels with 0 < target (< `max_depth`) are valid.
      alignment: `metric` none; `scale` ten reweighted steps towards the least absolute error; `median` ratio
        of the lower medians; `lstsq` least-squares scale and shift; `scale_shift` at most 1,000 Adam steps on
        the sum of absolute errors.
      max_depth: exclusive upper bound of valid target depth.
      clip: upper bound put on the aligned prediction (Sintel: 70 m).
      mask: [..., H, W] bool; restricts the errors, not the alignment.

    Returns:
      `abs_rel`, `sq_rel`, `rmse`, `log_rmse`, `delta_1.25`, `delta_1.25^2`, `delta_1.25^3` (fractions) and
      `valid_pixels`; all 0 without a valid pixel. A NaN in a valid pixel makes the means NaN and counts as a
      miss in the fractions.

    Raises:
      ValueError: unknown alignment, shapes that differ, a mask that is not boolean.
    """
    prediction, target = np.asarray(prediction), np.asarray(target)
    if prediction.shape != target.shape:
        raise ValueError(
            f"depth_metrics: prediction {prediction.shape} and target {target.shape} must agree; "
            "resize the prediction with resize_depth"
        )
    if mask is not None and (mask.shape != target.shape or mask.dtype != np.bool_):
        raise ValueError(f"depth_metrics: mask must be bool of shape {target.shape}, got {mask.dtype} {mask.shape}")
    if alignment not in ALIGNMENTS:
        raise ValueError(f"depth_metrics: alignment must be one of {ALIGNMENTS}, got {alignment!r}")
    return _errors(_valid_pixels(prediction, target, max_depth, mask), alignment, clip)


def clip_depth_metrics(
    prediction: np.ndarray,
    target: np.ndarray,
    *,
    alignments: Sequence[str],
    max_depth: float | None = None,
    clip: float | None = None,
) -> dict[str, dict[str, float]]:
    """`depth_metrics` of a long clip under several alignments, the prediction at any size.

    Args:
      prediction: [T, h, w], resized frame by frame as `resize_depth` does where its size is not the target's.
      target: [T, H, W]. Both may be memory maps: one frame is in memory at a time, and of the valid pixels what
        `scratch_array` keeps there.
      alignments: some of `ALIGNMENTS`.
      max_depth: as in `depth_metrics`.
      clip: as in `depth_metrics`.

    Returns:
      The errors by alignment.
    """
    pixels = _valid_pixels(prediction, target, max_depth, None)
    return {alignment: _errors(pixels, alignment, clip) for alignment in alignments}


def align_depth(prediction: np.ndarray, target: np.ndarray, alignment: str) -> tuple[float, float]:
    """Scale and shift that carry valid depths `prediction` [N] onto `target` [N]; see `depth_metrics`.

    `lstsq` and `scale_shift` take copies of both, the other alignments a block at a time.
    """
    if alignment == "metric":
        return 1.0, 0.0
    if alignment == "scale":
        return _least_absolute_scale(prediction, target), 0.0
    if alignment == "median":
        return _median_scale(prediction, target), 0.0
    prediction, target = np.asarray(prediction, np.float64), np.asarray(target, np.float64)
    if alignment == "lstsq":
        return _least_squares(prediction, target)
    return _adam_scale_shift(prediction, target)


def lower_median(values: np.ndarray) -> float:
    """Median that takes the lower of two middle values, as torch.median; NaN if any value is NaN.

    Values are selected digit by digit (a radix of 16 bits): exact, and a block of them in memory at a time.
    """
    values = np.ravel(values)
    if values.dtype not in (np.float32, np.float64):
        values = values.astype(np.float64)
    unsigned = np.dtype(f"u{values.dtype.itemsize}").type
    rank, prefix = (values.size - 1) // 2, 0
    for shift in range(8 * values.dtype.itemsize - 16, -1, -16):
        counts = np.zeros(2**16, np.int64)
        for (block,) in _blocks(values):
            if np.isnan(block).any():
                return float("nan")
            # The leading digits so far (none yet: 0 = 0), then this one.
            keys = _ordered_bits(block) >> unsigned(shift)
            digits = (keys & unsigned(0xFFFF))[keys >> unsigned(16) == prefix]
            counts += np.bincount(digits.astype(np.intp), minlength=2**16)
        below = np.cumsum(counts)
        digit = int(np.searchsorted(below, rank, side="right"))
        rank -= int(below[digit - 1]) if digit else 0
        prefix = prefix << 16 | digit
    sign = 1 << (8 * values.dtype.itemsize - 1)
    bits = prefix ^ sign if prefix & sign else ~prefix & (2 * sign - 1)
    return float(unsigned(bits).view(values.dtype))


def mean_depth_metrics(clips: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Data-set score: the mean over clips weighted by valid pixels. NaN without a valid pixel."""
    weights = np.array([clip["valid_pixels"] for clip in clips], np.float64)
    total = float(weights.sum())
    scores = {
        key: float(weights @ np.array([clip[key] for clip in clips])) / total if total else float("nan")
        for key in DEPTH_KEYS
    }
    return {**scores, "valid_pixels": total}


def resize_depth(depth: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Predicted depth [T, h, w] at `size` (H, W), resampled as the reference does: OpenCV bicubic.

    For predictions only: ground truth has holes that must not be interpolated.
    """
    import cv2

    height, width = size
    frames = [cv2.resize(frame, (width, height), interpolation=cv2.INTER_CUBIC) for frame in depth]
    return np.stack(frames)


class _Pixels(NamedTuple):
    """Depth of the valid pixels of a clip, in order; `scored` bool [N], None for all."""

    prediction: np.ndarray
    target: np.ndarray
    scored: np.ndarray | None


def _valid_pixels(
    prediction: np.ndarray, target: np.ndarray, max_depth: float | None, mask: np.ndarray | None
) -> _Pixels:
    frames, predicted = (array.reshape(-1, *array.shape[-2:]) for array in (target, prediction))
    masks = None if mask is None else mask.reshape(frames.shape)
    count = sum(int(_valid(frame, max_depth).sum()) for frame in frames)
    pixels = _Pixels(
        scratch_array((count,), predicted.dtype),
        scratch_array((count,), frames.dtype),
        None if masks is None else scratch_array((count,), np.bool_),
    )
    start = 0
    for t, frame in enumerate(track(frames, len(frames), "valid depth")):
        valid = _valid(frame, max_depth)
        stop = start + int(valid.sum())
        shown = predicted[t]
        if shown.shape != frame.shape:
            shown = resize_depth(shown[None], frame.shape)[0]
        pixels.prediction[start:stop], pixels.target[start:stop] = shown[valid], frame[valid]
        if masks is not None and pixels.scored is not None:
            pixels.scored[start:stop] = masks[t][valid]
        start = stop
    return pixels


def _valid(target: np.ndarray, max_depth: float | None) -> np.ndarray:
    return target > 0 if max_depth is None else (target > 0) & (target < max_depth)


def _errors(pixels: _Pixels, alignment: str, clip: float | None) -> dict[str, float]:
    scored = pixels.target.size if pixels.scored is None else int(pixels.scored.sum())
    if not scored:
        return {**dict.fromkeys(DEPTH_KEYS, 0.0), "valid_pixels": 0.0}
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        scale, shift = align_depth(pixels.prediction, pixels.target, alignment)
        sums = np.zeros(len(DEPTH_KEYS))
        columns = pixels[:2] if pixels.scored is None else pixels
        for predicted, true, *kept in _blocks(*columns):
            if kept:
                predicted, true = predicted[kept[0]], true[kept[0]]
            predicted, true = scale * predicted.astype(np.float64) + shift, true.astype(np.float64)
            if clip is not None:
                predicted = np.minimum(predicted, clip)
            error = predicted - true
            clamped = np.maximum(predicted, _SMALLEST_DEPTH)
            ratio = np.maximum(clamped / true, true / clamped)
            sums += [
                np.sum(np.abs(error) / true),
                np.sum(error**2 / true),
                np.sum(error**2),
                np.sum((np.log(clamped) - np.log(true)) ** 2),
                *(np.sum(ratio < 1.25**power) for power in (1, 2, 3)),
            ]
        means = dict(zip(DEPTH_KEYS, (sums / scored).tolist(), strict=True))
        for key in ("rmse", "log_rmse"):
            means[key] = float(np.sqrt(means[key]))
        return {**means, "valid_pixels": float(scored)}


def _blocks(*columns: Any) -> Iterator[tuple[np.ndarray, ...]]:
    for start in range(0, len(columns[0]), _BLOCK):
        yield tuple(np.asarray(column[start : start + _BLOCK]) for column in columns)


def _ordered_bits(values: np.ndarray) -> np.ndarray:
    """Unsigned integers in the order of the floating-point values [N]."""
    bits = values.view(f"u{values.dtype.itemsize}")
    sign = bits.dtype.type(1 << (8 * values.dtype.itemsize - 1))
    return np.where(bits & sign, ~bits, bits | sign)


def _least_absolute_scale(prediction: np.ndarray, target: np.ndarray, iterations: int = 10) -> float:
    def sums(terms: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> tuple[np.float64, np.float64]:
        above, below = np.float64(0.0), np.float64(0.0)
        for predicted, true in _blocks(prediction, target):
            numerator, denominator = terms(predicted.astype(np.float64), true.astype(np.float64))
            above, below = above + numerator.sum(), below + denominator.sum()
        return above, below

    def reweighted(predicted: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        weights = 1.0 / (np.abs(scale * predicted - true) + 1e-8)
        return weights * predicted * true, weights * predicted**2

    # A residual near zero weighs up to 1e8, so that the result depends on how these expressions round.
    true_sum, predicted_sum = sums(lambda predicted, true: (true, predicted))
    scale = (true_sum / target.size) / (predicted_sum / target.size)
    for _ in range(iterations):
        above, below = sums(reweighted)
        scale = above / below
    return float(np.maximum(scale, _SMALLEST_SCALE))


def _median_scale(prediction: np.ndarray, target: np.ndarray) -> float:
    # Python's own division raises for a prediction of zeros; the reference's gives infinity.
    return float(np.divide(lower_median(target), lower_median(prediction)))


def _least_squares(prediction: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    if not np.isfinite(prediction).all():
        return float("nan"), float("nan")
    design = np.stack([prediction, np.ones_like(prediction)], axis=1)
    (scale, shift), *_ = np.linalg.lstsq(design, target)
    return float(scale), float(shift)


def _adam_scale_shift(prediction: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """Follows the reference step by step, since it stops far from the optimum."""
    rate, beta1, beta2, epsilon = 1e-4, 0.9, 0.999, 1e-8
    start = _median_scale(prediction, target)
    # Float32 as the reference: the start puts one residual at round-off, and its sign decides the first steps.
    prediction, target = prediction.astype(np.float32), target.astype(np.float32)
    parameters: np.ndarray = np.array([start, 0.0], np.float32)
    first: np.ndarray = np.zeros(2, np.float32)
    second: np.ndarray = np.zeros(2, np.float32)
    previous = np.inf
    for step in range(1, 1001):
        residual = parameters[0] * prediction + parameters[1] - target
        loss = float(np.abs(residual).sum())
        sign = np.sign(residual)
        gradient = np.array([(sign * prediction).sum(), sign.sum()])
        first = beta1 * first + (1 - beta1) * gradient
        second = beta2 * second + (1 - beta2) * gradient**2
        denominator = np.sqrt(second / (1 - beta2**step)) + epsilon
        parameters = parameters - rate * (first / (1 - beta1**step)) / denominator
        if abs(previous - loss) < 1e-6:
            break
        previous = loss
    return float(parameters[0]), float(parameters[1])
