"""Short clips with all metrics, of any data set at one small size: the benchmark of small models."""

from __future__ import annotations

from logvggt_jax.evaluation.protocols.frame_selection import Clips
from logvggt_jax.evaluation.protocols.images import Fit
from logvggt_jax.evaluation.protocols.protocol import DepthMeasure, PointsMeasure, Protocol
from logvggt_jax.evaluation.settings import EvaluationConfig


def clip_protocols(dataset: str, split: str, config: EvaluationConfig) -> list[Protocol]:
    """One benchmark for each clip length of `config`."""
    return [
        Protocol(
            name=f"{dataset}-clips-{length}",
            title=f"clips of {length} frames",
            dataset=dataset,
            splits=(split,),
            frames=Clips(length, config.stride, config.clips_per_sequence),
            images=Fit(config.image_size),
            depth=DepthMeasure(),
            points=PointsMeasure(None, config.max_points, config.icp_threshold, config.seed),
            poses=True,
            trajectory=True,
        )
        for length in config.clip_lengths
    ]
