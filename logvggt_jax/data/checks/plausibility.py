"""What can be wrong with frames that decode: blank pictures, depth in another unit, calibrations of another size."""

from collections.abc import Iterator

import numpy as np

from logvggt_jax.data.readers.folder_dataset import FolderDataset, FrameRecord
from logvggt_jax.frames import Frames

BLACK = 16
"""Brightest level of a picture that is called black; the darkest frames of videos in use are well above."""

ONE_COLOUR = 4
"""Levels by which all channels of a picture of one colour may vary: lossy compression leaves about that."""

OFF_CENTRE = 0.2
"""Distance of the principal point from a picture's centre, as a share of its edge, above which the calibration is said
to belong to pictures of another size: for a picture half or twice as large it is 0.5 or 0.25."""

_SAMPLED = 50_000  # pixels that are looked at, evenly spread
_COMMON = (1, 99)  # percentiles: dead pixels and dates burnt in do not count


def complaints(dataset: FolderDataset, record: FrameRecord, frames: Frames) -> Iterator[tuple[str, str]]:
    """Kind and message of what is implausible in `frames`, which holds the frame `record` of `dataset` alone.

    Depth is judged by its median, where lengths are metres, against `dataset.plausible_depth`.
    """
    colour = _blank(frames.images[0])
    if colour is not None:
        yield (
            "blank picture",
            f"{record.image}: {colour} throughout: fetch it again; if it stays so, leave its sequence out",
        )
    depth = frames.depth[0]
    valid = depth[depth > 0]
    if dataset.metric and valid.size:
        median, (low, high) = float(np.median(valid)), dataset.plausible_depth
        if not low <= median <= high:
            yield (
                "implausible depth",
                f"{record.depth}: the median of its depth is {median:.4g} m, {low:g} to {high:g} expected: it may be "
                "in another unit (millimetres for metres, or the reverse); fetch the data set's original file",
            )
    height, width = depth.shape
    cx, cy = frames.intrinsics[0, :2, 2]
    away = max(abs(cx - (width - 1) / 2) / width, abs(cy - (height - 1) / 2) / height)
    if dataset.centred and away > OFF_CENTRE:
        yield (
            "calibration of another size",
            f"{record.calibration or record.image}: the principal point ({cx:.1f}, {cy:.1f}) is far from the centre of "
            f"a picture of {width} x {height}, as {record.image.name} is: the calibration belongs to pictures of "
            "another size or another crop: fetch both again",
        )


def _blank(image: np.ndarray) -> str | None:
    """What is seen in a picture [H, W, 3] uint8 without content; None where there is some."""
    pixels = image.reshape(-1, 3)
    low, high = np.percentile(pixels[:: max(1, len(pixels) // _SAMPLED)], _COMMON, axis=0)
    if high.max() <= BLACK:
        return "black"
    if (high - low).max() <= ONE_COLOUR:
        red, green, blue = np.rint((low + high) / 2).astype(int)
        return f"one colour (red {red}, green {green}, blue {blue})"
    return None
