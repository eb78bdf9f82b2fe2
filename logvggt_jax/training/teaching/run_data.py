"""The data of a run: of its own truth, or labelled by a teacher before the first step."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from logvggt_jax.data.cache_use import cache_in_use
from logvggt_jax.data.dataset import Dataset
from logvggt_jax.training.config import TeacherConfig, TrainConfig
from logvggt_jax.training.feeding.sources import open_source, open_sources
from logvggt_jax.training.feeding.truth import check_depth, check_truth
from logvggt_jax.training.parallel.agreement import check_shared
from logvggt_jax.training.teaching.labelling import taught
from logvggt_jax.training.teaching.teacher import PlainVGGT, Teacher, check_teacher
from logvggt_jax.weights.address import hub_address


def open_data(config: TrainConfig) -> tuple[Mapping[str, Dataset], Sequence[Dataset]]:
    """The mixture's data sets by name, and the validation sets where they are not simply their sources.

    With a teacher every clip is labelled here, or found in the cache; the teacher is gone when this returns. Raises
    InputError as `check_truth`, `check_teacher`, `open_sources`, `check_depth`, `PlainVGGT` and `taught`.
    """
    check_truth(config)
    # What is at hand is looked at before data are listed or drawn; gigabytes are downloaded and read after that.
    if config.teacher is not None and hub_address(config.teacher.weights) is None:
        check_teacher(config.teacher)
    datasets = open_sources(config.data, () if config.validation is None else config.validation.sources)
    check_depth(config, datasets)
    if config.teacher is None:
        return datasets, ()
    labelled = label(config, config.teacher, PlainVGGT(config.teacher), datasets)
    # The programs of the teacher hold memory that the student's step needs.
    jax.clear_caches()
    return labelled


def label(
    config: TrainConfig,
    settings: TeacherConfig,
    teacher: Teacher,
    datasets: Mapping[str, Dataset],
    *,
    most: int | None = None,
) -> tuple[Mapping[str, Dataset], Sequence[Dataset]]:
    """`datasets`, and the validation sources where the student is to be compared with its teacher, as it labels them.

    Of several processes each labels its share; all have to call this. At `most` so many clips of a set are labelled,
    None labels all. Raises InputError as `taught`, and on every process where they do not share the cache.
    """
    assert config.data.cache_dir is not None  # as the configuration checks
    shared: dict[str, Any] = {"progress": jax.process_index() == 0, "most": most}
    cache = Path(config.data.cache_dir)
    sizes = list(dict.fromkeys(size for stage in config.stages for size in stage.sizes))
    # Each reads what the others have labelled.
    check_shared(cache, "data.cache_dir")
    validated: list[Dataset] = []
    with cache_in_use(cache, "teacher", ("teacher/*.partial", "teacher/.*.old")):
        found: dict[str, Dataset] = {
            name: taught(name, dataset, teacher, settings, sizes, cache, **shared) for name, dataset in datasets.items()
        }
        if config.validation is not None and settings.validation:
            size = [config.validation.size]
            for source in config.validation.sources:
                held_out = taught(source.name, open_source(source), teacher, settings, size, cache, **shared)
                # Validation replaces no clip that cannot be read.
                validated.append(held_out.labelled())
    return found, validated
