"""Video depth: alignment of a clip's depth to the ground truth, and the field's error measures.

Source: the evaluation code of CUT3R and its descendants (`eval/video_depth/tools.py`), in float64.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

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
        the sum of absolute errors. As in the reference the factor of `scale` is at least 0.001 and these steps have one
        length in every unit: a prediction in millimetres for a target in metres suits neither.
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
    mask = None if mask is None else np.asarray(mask)
    if mask is not None and (mask.shape != target.shape or mask.dtype != np.bool_):
        raise ValueError(f"depth_metrics: mask must be bool of shape {target.shape}, got {mask.dtype} {mask.shape}")
    valid = valid_depth(target, max_depth)
    scored = None if mask is None else mask[valid]
    return pixel_errors(prediction[valid], target[valid], alignment=alignment, clip=clip, scored=scored)


def valid_depth(target: np.ndarray, max_depth: float | None) -> np.ndarray:
    """Bool of the target's shape: 0 < target (< `max_depth`)."""
    return target > 0 if max_depth is None else (target > 0) & (target < max_depth)


def pixel_errors(
    prediction: np.ndarray,
    target: np.ndarray,
    *,
    alignment: str,
    clip: float | None = None,
    scored: np.ndarray | None = None,
) -> dict[str, float]:
    """The errors of `depth_metrics` from the valid pixels of a clip.

    Predicted and true depth are [N], the true above 0; both may be memory maps, of which a block at a time is read.
    `alignment` and `clip` are those of `depth_metrics`, measured on all N pixels; `scored` bool [N] are the pixels
    whose errors count, None for all.
    """
    if alignment not in ALIGNMENTS:
        raise ValueError(f"depth_metrics: alignment must be one of {ALIGNMENTS}, got {alignment!r}")
    count = target.size if scored is None else int(scored.sum())
    if not count:
        return {**dict.fromkeys(DEPTH_KEYS, 0.0), "valid_pixels": 0.0}
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        scale, shift = align_depth(prediction, target, alignment)
        sums = np.zeros(len(DEPTH_KEYS))
        columns = (prediction, target) if scored is None else (prediction, target, scored)
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
        means = dict(zip(DEPTH_KEYS, (sums / count).tolist(), strict=True))
        for key in ("rmse", "log_rmse"):
            means[key] = float(np.sqrt(means[key]))
        return {**means, "valid_pixels": float(count)}


def align_depth(prediction: np.ndarray, target: np.ndarray, alignment: str) -> tuple[float, float]:
    """Scale and shift that carry valid depths `prediction` [N] onto `target` [N]; see `depth_metrics`.

    `lstsq` and `scale_shift` copy both, `median` one after the other; `scale` reads a block at a time.
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

    Takes one copy of the values in memory, also of a memory map: 0.6 GB for 500 frames of 640 x 480, the longest
    benchmark of depth.
    """
    values = np.ravel(values)
    if np.isnan(values.max()):
        return float("nan")
    middle = (values.size - 1) // 2
    return float(np.partition(values, middle)[middle])


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


def _blocks(*columns: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """Columns [N] in pieces that fit the memory."""
    for start in range(0, len(columns[0]), _BLOCK):
        yield tuple(np.asarray(column[start : start + _BLOCK]) for column in columns)


def _least_absolute_scale(prediction: np.ndarray, target: np.ndarray) -> float:
    """The scale that minimises Σ |scale · prediction − target| over pixels [N], by ten reweighted least squares."""

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
    for _ in range(10):
        above, below = sums(reweighted)
        scale = above / below
    return float(np.maximum(scale, _SMALLEST_SCALE))


def _median_scale(prediction: np.ndarray, target: np.ndarray) -> float:
    """The ratio of the medians of pixels [N]."""
    # Python's own division raises for a prediction of zeros; the reference's gives infinity.
    return float(np.divide(lower_median(target), lower_median(prediction)))


def _least_squares(prediction: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """Scale and shift of least squares over pixels [N]; NaN where a prediction is not finite."""
    if not np.isfinite(prediction).all():
        return float("nan"), float("nan")
    design = np.stack([prediction, np.ones_like(prediction)], axis=1)
    (scale, shift), *_ = np.linalg.lstsq(design, target)
    return float(scale), float(shift)


def _adam_scale_shift(prediction: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """Scale and shift of pixels [N] by Adam, step by step as the reference, which stops far from the optimum."""
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
