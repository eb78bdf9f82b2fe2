"""Answers that need no learning, to be printed beside every result."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.feeding.transforms import fit
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.methods.method import Checkpoint, ClipPrediction, Method, model_row
from logvggt_jax.frames import evenly_spaced
from logvggt_jax.model.logvggt import LogVGGT

_SEQUENCES = 64  # of a data set whose depth is looked at, at most


@dataclasses.dataclass(frozen=True)
class DepthStatistics:
    """What the depth baselines know."""

    mean_depth: float  # mean over all valid pixels
    mean_map: np.ndarray  # [H, W] mean over the valid frames of each pixel; `mean_depth` where none is valid
    intrinsics: np.ndarray  # [3, 3] mean, pixels of [H, W]
    source: str  # the frames that these are means of, in words


def depth_statistics(
    dataset: Dataset, image_size: tuple[int, int], *, source: str, max_frames: int = 256
) -> DepthStatistics:
    """Mean depth, mean depth map and mean intrinsics of evenly spaced frames, fitted to `image_size` (H, W).

    They are of some sequences and `max_frames` frames at most, the same number from each; `source` is their
    name in the table. Raises InputError where no frame has a valid depth.
    """
    depth_sum, valid_count = np.zeros(image_size), np.zeros(image_size)
    intrinsics: list[np.ndarray] = []
    sequences = list(dataset.sequences)
    chosen = evenly_spaced(len(sequences), _SEQUENCES)
    for s in chosen:
        # One frame at a time: hundreds at a data set's own size are gigabytes.
        for index in evenly_spaced(dataset.num_frames(sequences[s]), max(1, max_frames // len(chosen))):
            frames = fit(dataset.read(sequences[s], [index]), image_size)
            valid = frames.depth[0] > 0
            depth_sum += np.where(valid, frames.depth[0], 0.0)
            valid_count += valid
            intrinsics.append(frames.intrinsics[0])
    if not valid_count.any():
        raise InputError(f"{source} have no valid depth; the baselines need some, or config.baselines=False")
    mean_depth = float(depth_sum.sum() / valid_count.sum())
    mean_map = np.where(valid_count > 0, depth_sum / np.maximum(valid_count, 1), mean_depth)
    return DepthStatistics(mean_depth, mean_map, np.mean(intrinsics, axis=0), source)


def unit_depth() -> Method:
    """Every pixel at depth 1, at any image size; the alignment gives it the clip's scale."""

    def predict(images: np.ndarray) -> ClipPrediction:
        depth = np.broadcast_to(np.float32(1.0), images.shape[:3])
        return ClipPrediction(depth, _identities(len(images)), None)

    return Method("constant depth", "nothing", predict, pose=False, points=False)


def static_camera() -> Method:
    """All frames at the first camera's pose."""

    def predict(images: np.ndarray) -> ClipPrediction:
        return ClipPrediction(None, _identities(len(images)), None)

    return Method("static camera", "nothing", predict, depth=False, points=False, static=True)


def untrained(model: LogVGGT, image_size: tuple[int, int], *, seed: int = 0) -> Method:
    """The same network with random parameters."""
    variables = model.init(jax.random.key(seed), jnp.zeros((1, 1, *image_size, 3), jnp.uint8))
    knows = f"nothing (random parameters, seed {seed})"
    return model_row(
        "windows", Checkpoint(model, jax.device_put(variables), knows), name="untrained network", knows=knows
    )


def all_baselines(
    model: LogVGGT, dataset: Dataset, image_size: tuple[int, int], *, source: str, seed: int = 0
) -> list[Method]:
    """Constant depth, mean depth map, static camera and the untrained network.

    The depth baselines take their means of frames of `dataset`, which `source` names in the table; the untrained
    network has the sizes of `model`, whose input is of `image_size` (H, W), and random parameters from `seed`.
    """
    statistics = depth_statistics(dataset, image_size, source=source)
    constant = np.full_like(statistics.mean_map, statistics.mean_depth)
    return [
        _fixed_depth("constant depth", "mean depth", constant, statistics),
        _fixed_depth("mean depth map", "mean depth of each pixel", statistics.mean_map, statistics),
        static_camera(),
        untrained(model, image_size, seed=seed),
    ]


def _fixed_depth(name: str, knows: str, depth: np.ndarray, statistics: DepthStatistics) -> Method:
    """The same depth map [H, W] for every frame, seen by a camera that never moves."""

    def predict(images: np.ndarray) -> ClipPrediction:
        frames = len(images)
        return ClipPrediction(
            np.broadcast_to(depth, (frames, *depth.shape)),
            _identities(frames),
            np.broadcast_to(statistics.intrinsics, (frames, 3, 3)),
        )

    knows = f"{knows} and mean intrinsics of {statistics.source}; static camera"
    identity = [array.tolist() for array in (depth, statistics.intrinsics)]
    return Method(name, knows, predict, identity, pose=False)


def _identities(count: int) -> np.ndarray:
    """[count, 4, 4]."""
    return np.tile(np.eye(4), (count, 1, 1))
