"""One clip read for evaluation: images for the network and the truth, on disk where they are large."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.progress import track
from logvggt_jax.evaluation.protocols.images import ImageRule
from logvggt_jax.evaluation.scratch import scratch_array


class ClipData(NamedTuple):
    """Frames of a clip, numpy arrays; `images` and `depth` may be memory maps."""

    images: np.ndarray  # [T, h, w, 3] uint8, what the network sees
    # [T, H, W] float32 true z-depth, 0 where invalid; None where no metric needs it. On the images' pixels or the data
    # set's, as the image rule says.
    depth: np.ndarray | None
    intrinsics: np.ndarray  # [T, 3, 3] float32, pixels of `depth`
    extrinsics: np.ndarray  # [T, 4, 4] float32, world-to-camera (OpenCV); NaN in sets without poses
    # [T, 4, 4], a second set of true poses from structure from motion; None where there is none.
    sfm_extrinsics: np.ndarray | None = None


def load_clip(
    dataset: Dataset, sequence: str, indices: Sequence[int], rule: ImageRule, *, depth: bool = True
) -> ClipData:
    """Reads the frames `indices` of `sequence` one by one.

    Raises as the data set's `read`, InputError where images of one clip differ in size, ValueError without frames.
    """
    count = len(indices)
    clip: ClipData | None = None
    for t, index in enumerate(track(indices, count, f"reading {count} frames")):
        frame = rule(dataset.read(sequence, [index]))
        if clip is None:
            clip = ClipData(
                scratch_array((count, *frame.images.shape[1:]), np.uint8),
                scratch_array((count, *frame.depth.shape[1:]), np.float32) if depth else None,
                np.zeros((count, 3, 3), np.float32),
                np.zeros((count, 4, 4), np.float32),
            )
        if frame.images.shape[1:] != clip.images.shape[1:]:
            raise InputError(
                f"{sequence}: frame {index} has size {frame.images.shape[1:3]} after resizing, frame {indices[0]} has "
                f"{clip.images.shape[1:3]}; frames of a clip must have one size"
            )
        clip.images[t], clip.intrinsics[t], clip.extrinsics[t] = (
            frame.images[0],
            frame.intrinsics[0],
            frame.extrinsics[0],
        )
        if clip.depth is not None:
            clip.depth[t] = frame.depth[0]
    if clip is None:
        raise ValueError(f"{sequence}: a clip needs at least one frame")
    return clip._replace(sfm_extrinsics=dataset.sfm_extrinsics(sequence, indices))
