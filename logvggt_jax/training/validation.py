"""Accuracy on a few fixed clips that training never sees."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import PartitionSpec as P

from logvggt_jax.data.feeding.transforms import fit
from logvggt_jax.errors import InputError
from logvggt_jax.metrics.depth import depth_metrics
from logvggt_jax.metrics.pose import pose_accuracy, relative_pose_errors
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.training.batches import open_source
from logvggt_jax.training.config import SourceConfig, ValidationConfig
from logvggt_jax.training.pictures import clip_picture, trajectory_picture
from logvggt_jax.training.sharding import DATA_AXIS, Layout, replicated, split
from logvggt_jax.types import Frames


class Judgement(NamedTuple):
    """What validation finds.

    Attributes:
      values: means over the clips of all sources, `validation/abs_rel`, and where there are several over those of each,
        `validation/SOURCE/abs_rel`. Depth is judged after median alignment, poses by errors over all pairs, in degrees.
        `constant_abs_rel` and `identity_rotation` are what a constant depth and a motionless camera get.
      pictures: of the first clip of each source, [h, w, 3] uint8 RGB.
    """

    values: dict[str, float]
    pictures: dict[str, np.ndarray]


class Validation:
    """Fixed clips, read once, and the jitted model that is tried on them.

    Clip i of a source shows frames 0, stride, 2 stride, … of the i-th sequence that is long enough.
    """

    def __init__(self, model: LogVGGT, config: ValidationConfig, layout: Layout) -> None:
        mesh = layout.mesh
        self._names = [source.name for source in config.sources]
        self._clips = [clip for source in config.sources for clip in _read_clips(source, config)]
        self._each = config.num_clips
        firsts = np.arange(0, len(self._clips), self._each)
        self._without_learning = [_baselines(clip) for clip in self._clips]
        # The last clip again, as often as the devices need it for equal shares.
        shown = [*self._clips, *self._clips[-1:] * (-len(self._clips) % mesh.size)]
        images = np.stack([clip.images for clip in shown])
        self._images = jax.make_array_from_callback(images.shape, split(mesh), lambda index: images[index])

        def predict(params: Any, images: jax.Array) -> tuple[jax.Array, ...]:
            predictions = model.apply({"params": layout.in_parts(params)}, images)
            return predictions.depth, predictions.extrinsics, predictions.depth_confidence

        def on_all_devices(params: Any, images: jax.Array) -> tuple[jax.Array, ...]:
            specs = (layout.specs(params), P(DATA_AXIS))
            depth, extrinsics, confidence = jax.shard_map(
                predict, mesh=mesh, in_specs=specs, out_specs=P(DATA_AXIS), check_vma=False
            )(params, images)
            return depth, extrinsics, confidence[firsts]

        self._predict = jax.jit(on_all_devices, out_shardings=replicated(mesh))

    def __call__(self, params: Any) -> Judgement:
        """Judges these parameters."""
        count = len(self._clips)
        depth, extrinsics, confidence = jax.device_get(self._predict(params, self._images))
        results = [
            {**_clip_metrics(*each), **known}
            for *each, known in zip(depth[:count], extrinsics[:count], self._clips, self._without_learning, strict=True)
        ]
        values = _means(results, "validation")
        pictures = {}
        for number, name in enumerate(self._names):
            first = number * self._each
            if len(self._names) > 1:
                values |= _means(results[first : first + self._each], f"validation/{name}")
            clip = self._clips[first]
            pictures[f"validation/{name}/clip"] = clip_picture(clip, depth[first], confidence[number])
            pictures[f"validation/{name}/trajectory"] = trajectory_picture(extrinsics[first], clip.extrinsics)
        return Judgement(values, pictures)


def _means(results: list[dict[str, float]], prefix: str) -> dict[str, float]:
    means = {name: float(np.mean([result[name] for result in results])) for name in results[0]}
    means["rotation_over_identity"] = means["rotation"] / max(means["identity_rotation"], 1e-6)
    return {f"{prefix}/{name}": value for name, value in means.items()}


def _read_clips(source: SourceConfig, config: ValidationConfig) -> list[Frames]:
    dataset = open_source(source)
    indices = [i * config.stride for i in range(config.clip_length)]
    names = [name for name in dataset.sequences if dataset.num_frames(name) > indices[-1]]
    if len(names) < config.num_clips:
        raise InputError(
            f"validation: data set {source.name!r} has {len(names)} sequences of at least {indices[-1] + 1} "
            f"frames, num_clips={config.num_clips} needs more; lower num_clips, clip_length or stride"
        )
    return [fit(dataset.read(name, indices), config.size) for name in names[: config.num_clips]]


def _clip_metrics(depth: np.ndarray, extrinsics: np.ndarray, clip: Frames) -> dict[str, float]:
    """Errors of one clip: depth [T, H, W], world-to-camera extrinsics [T, 3, 4]; angles in degrees."""
    found = depth_metrics(depth, clip.depth, alignment="median")
    rotation, direction = relative_pose_errors(extrinsics, clip.extrinsics)
    return {
        "abs_rel": found["abs_rel"],
        "delta_1.25": found["delta_1.25"],
        "rotation": float(rotation.mean()),
        "translation_direction": float(direction.mean()),
        "auc_30": pose_accuracy(rotation, direction)["auc"],
    }


def _baselines(clip: Frames) -> dict[str, float]:
    """What a constant depth and a motionless camera get on a clip, whatever the model has learned."""
    constant = depth_metrics(np.ones_like(clip.depth), clip.depth, alignment="median")
    still = np.broadcast_to(np.eye(4), clip.extrinsics.shape)
    identity, _ = relative_pose_errors(still, clip.extrinsics)
    return {"constant_abs_rel": constant["abs_rel"], "identity_rotation": float(identity.mean())}
