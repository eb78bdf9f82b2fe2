"""Accuracy on a few fixed clips that training never sees."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import PartitionSpec as P

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.feeding.frame_range import longest
from logvggt_jax.data.feeding.transforms import fit
from logvggt_jax.errors import InputError
from logvggt_jax.metrics.depth import depth_metrics
from logvggt_jax.metrics.pose import pose_accuracy, relative_pose_errors
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.training.config import ValidationConfig
from logvggt_jax.training.feeding.sources import open_source
from logvggt_jax.training.parallel.sharding import DATA_AXIS, Layout, replicated, split
from logvggt_jax.training.validation.pictures import clip_picture, trajectory_picture
from logvggt_jax.types import Frames


class Judgement(NamedTuple):
    """What validation finds.

    Attributes:
      values: means over the clips of all sources, `validation/abs_rel`, and where there are several over those of each,
        `validation/SOURCE/abs_rel`. Depth is judged after median alignment, poses by errors over all pairs, in degrees.
        `constant_abs_rel` and `identity_rotation` are what a constant depth and a motionless camera get. Clips without
        depth count for nothing in errors of depth, which are NaN where no clip has any.
      pictures: of the first clip of each source, [h, w, 3] uint8 RGB.
    """

    values: dict[str, float]
    pictures: dict[str, np.ndarray]


class Validation:
    """Fixed clips, read once, and the jitted model that is tried on them, on each device clip by clip.

    Clip i of a source shows frames start, start + stride, … of a sequence that is long enough. As many sequences as
    there are have clips; those of one sequence start evenly spaced, the first one at frame 0. `datasets` take the place
    of the sources that the configuration names.
    """

    def __init__(
        self, model: LogVGGT, config: ValidationConfig, layout: Layout, datasets: Sequence[Dataset] = ()
    ) -> None:
        mesh = layout.mesh
        self._names = [source.name for source in config.sources]
        opened = datasets or [open_source(source) for source in config.sources]
        each = zip(self._names, opened, strict=True)
        self._clips = [clip for name, dataset in each for clip in _read_clips(name, dataset, config)]
        self._each = config.num_clips
        firsts = np.arange(0, len(self._clips), self._each)
        self._without_learning = [_baselines(clip) for clip in self._clips]
        # The last clip again, as often as the devices need it for equal shares.
        shown = [*self._clips, *self._clips[-1:] * (-len(self._clips) % mesh.size)]
        images = np.stack([clip.images for clip in shown])
        self._images = jax.make_array_from_callback(images.shape, split(mesh), lambda index: images[index])

        def predict(params: Any, images: jax.Array) -> tuple[jax.Array, ...]:
            variables = {"params": layout.in_parts(params)}

            def one(clip: jax.Array) -> tuple[jax.Array, ...]:
                predictions = model.apply(variables, clip[None])
                return predictions.depth[0], predictions.extrinsics[0], predictions.depth_confidence[0]

            # One by one: what a device needs does not grow with the number of clips.
            found: tuple[jax.Array, ...] = jax.lax.map(one, images)
            return found

        def on_all_devices(params: Any, images: jax.Array) -> tuple[jax.Array, ...]:
            specs = (layout.specs(params), P(DATA_AXIS))
            depth, extrinsics, confidence = jax.shard_map(
                predict, mesh=mesh, in_specs=specs, out_specs=P(DATA_AXIS), check_vma=False
            )(params, images)
            return depth, extrinsics, confidence[firsts]

        self._predict = jax.jit(on_all_devices, out_shardings=replicated(mesh))
        self._compiled: jax.stages.Compiled | None = None

    @property
    def compiled(self) -> bool:
        """Whether a judgement takes no compilation any more."""
        return self._compiled is not None

    def compile(self, params: Any) -> None:
        """Makes ready what judges parameters of such shapes and in such places."""
        self._compiled = self._predict.lower(params, self._images).compile()

    def __call__(self, params: Any) -> Judgement:
        """Judges these parameters, which are such as it was compiled for if it was."""
        count, predict = len(self._clips), self._compiled or self._predict
        depth, extrinsics, confidence = jax.device_get(predict(params, self._images))
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


def validation_line(values: Mapping[str, float]) -> str:
    """What a `Judgement` says, on one line beside what learns nothing gets."""
    return (
        f"abs_rel {values['validation/abs_rel']:.3f} (constant depth {values['validation/constant_abs_rel']:.3f}), "
        f"delta<1.25 {values['validation/delta_1.25']:.3f}, "
        f"rotation {values['validation/rotation']:.2f}° (identity {values['validation/identity_rotation']:.2f}°), "
        f"direction {values['validation/translation_direction']:.1f}°"
    )


def _means(results: list[dict[str, float | None]], prefix: str) -> dict[str, float]:
    known = {name: [value for result in results if (value := result[name]) is not None] for name in results[0]}
    means = {name: float(np.mean(values)) if values else math.nan for name, values in known.items()}
    means["rotation_over_identity"] = means["rotation"] / max(means["identity_rotation"], 1e-6)
    return {f"{prefix}/{name}": value for name, value in means.items()}


def clip_starts(name: str, dataset: Dataset, config: ValidationConfig) -> list[tuple[str, int]]:
    """Sequence and first frame of every clip of a data set; InputError where it has not as many."""
    span = _span(config)
    # Starts that a sequence has room for.
    room = {sequence: dataset.num_frames(sequence) - span + 1 for sequence in dataset.sequences}
    sequences = [sequence for sequence in dataset.sequences if room[sequence] > 0][: config.num_clips]
    counts, left = dict.fromkeys(sequences, 0), config.num_clips
    # Dealt out in turn; what has no room left is passed over.
    while takers := [each for each in sequences if counts[each] < room[each]][:left]:
        for each in takers:
            counts[each] += 1
        left -= len(takers)
    if left:
        raise InputError(
            f"validation: data set {name!r} has {len(sequences)} sequences of at least {span} frames, "
            f"num_clips={config.num_clips} needs more or longer ones, {longest(dataset)}; lower num_clips, clip_length "
            "or stride"
        )
    return [
        (sequence, int(start))
        for sequence in sequences
        for start in np.linspace(0, room[sequence] - 1, counts[sequence]).round()
    ]


def _span(config: ValidationConfig) -> int:
    """Frames of a sequence from the first to the last of a clip."""
    return (config.clip_length - 1) * config.stride + 1


def _read_clips(name: str, dataset: Dataset, config: ValidationConfig) -> list[Frames]:
    return [
        fit(dataset.read(sequence, range(start, start + _span(config), config.stride)), config.size)
        for sequence, start in clip_starts(name, dataset, config)
    ]


def _clip_metrics(depth: np.ndarray, extrinsics: np.ndarray, clip: Frames) -> dict[str, float | None]:
    """Errors of one clip: depth [T, H, W], world-to-camera extrinsics [T, 3, 4]; angles in degrees."""
    found = _depth_errors(depth, clip)
    rotation, direction = relative_pose_errors(extrinsics, clip.extrinsics)
    return {
        "abs_rel": found["abs_rel"],
        "delta_1.25": found["delta_1.25"],
        "rotation": float(rotation.mean()),
        "translation_direction": float(direction.mean()),
        "auc_30": pose_accuracy(rotation, direction)["auc"],
    }


def _depth_errors(depth: np.ndarray, clip: Frames) -> dict[str, float | None]:
    found = depth_metrics(depth, clip.depth, alignment="median")
    # Without a valid pixel all of them are 0, which would be the best there is.
    return {name: found[name] if found["valid_pixels"] else None for name in ("abs_rel", "delta_1.25")}


def _baselines(clip: Frames) -> dict[str, float | None]:
    """What a constant depth and a motionless camera get on a clip, whatever the model has learned."""
    constant = _depth_errors(np.ones_like(clip.depth), clip)
    still = np.broadcast_to(np.eye(4), clip.extrinsics.shape)
    identity, _ = relative_pose_errors(still, clip.extrinsics)
    return {"constant_abs_rel": constant["abs_rel"], "identity_rotation": float(identity.mean())}
