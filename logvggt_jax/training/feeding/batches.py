"""One stream of batches for each stage of a run."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.feeding.batches import BatchIterator, training_batches
from logvggt_jax.training.config import DataConfig, StageConfig
from logvggt_jax.training.parallel.agreement import from_all


def stage_batches(
    datasets: Mapping[str, Dataset],
    config: DataConfig,
    stage: StageConfig,
    *,
    seed: int,
    state: Mapping[str, Any] | None = None,
) -> BatchIterator:
    """This process's share of the batches of a stage, after those that `state` counts; `seed` is the stage's own."""
    sources = [source for source in config.sources if source.name in datasets]
    return training_batches(
        datasets,
        clip_length=stage.clip_length,
        batch_size=stage.batch_size,
        sizes=stage.sizes,
        seed=seed,
        stride=(stage.min_stride, stage.max_stride),
        strides={source.name: source.stride for source in sources if source.stride is not None},
        reverse=config.reverse,
        weights={source.name: source.weight for source in sources},
        augmentation=config.augmentation,
        min_valid_depth=config.min_valid_depth,
        max_broken=config.max_broken,
        process_index=jax.process_index(),
        process_count=jax.process_count(),
        worker_count=config.worker_count,
        num_threads=config.num_threads,
        state=state,
    )


def with_all_broken(state: Mapping[str, Any]) -> dict[str, Any]:
    """A stream's state as a checkpoint keeps it: with the numbers of clips, and of broken ones, of all processes, from
    which process 0 counts on. All processes have to ask at the same point."""
    own = state["broken"]
    count, clips = from_all(np.array([own["count"], own["clips"]])).sum(0)
    return {**state, "broken": {**own, "count": int(count), "clips": int(clips)}}
