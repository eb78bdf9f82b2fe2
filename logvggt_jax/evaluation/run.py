"""A whole evaluation, from a configuration's values to the tables on disk."""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from logvggt_jax.evaluation.costs.throughput import measured_costs, measured_timings
from logvggt_jax.evaluation.datasets import open_run
from logvggt_jax.evaluation.methods.method import Checkpoint, Method, model_row
from logvggt_jax.evaluation.methods.variants import variant_methods
from logvggt_jax.evaluation.plan import image_sizes
from logvggt_jax.evaluation.records import RECORDS_FILE
from logvggt_jax.evaluation.report.report import write_report
from logvggt_jax.evaluation.runner import evaluate
from logvggt_jax.evaluation.settings import ClipRun, PaperRun, read_run
from logvggt_jax.files import FolderKind, FolderLock, check_output, check_writable
from logvggt_jax.streaming import METHODS, expectation
from logvggt_jax.weights.address import resolve
from logvggt_jax.weights.checkpoints import read_config, read_provenance

# Rows that a run has unless it says otherwise.
_REFERENCES = ("offline", "chunks")


def run_evaluation(
    configuration: Mapping[str, Any],
    checkpoint: str | Path,
    output: str | Path,
    *,
    data_root: str | Path | None = None,
    fresh: bool = False,
    command: str,
) -> dict[str, Any]:
    """Evaluates a checkpoint and writes clips.jsonl, results.json, tables, figures and report.

    Args:
      configuration: as a file of configs/eval gives it.
      checkpoint: model folder, or the name of a model that ships.
      output: folder of the results: a new or empty one, or an evaluation's. What an interrupted run of the same code
        has measured is taken over; other results are replaced once these are complete.
      data_root: folder of the data set, where it is read from disk; for the paper's benchmarks that of their folders.
      fresh: measure everything anew.
      command: what a reader has to run to get the same numbers.

    Returns:
      The content of results.json, see `evaluate`.

    Raises:
      DiskError: nothing can be written at `output`.
      OutputExists: `output` holds something else than an evaluation.
      InputError: a setting, the data or the checkpoint cannot be used, or another run is at work on `output`.
    """
    run = read_run(configuration)
    output = check_output(output, overwrite=True, kind=FolderKind(RECORDS_FILE, ("*",)), in_place=True)
    check_writable(output / RECORDS_FILE)
    asks = isinstance(run, ClipRun) and run.evaluation.image_size is None
    longer_edge = read_provenance(checkpoint).longer_edge if asks else None
    benchmarks, baselines = open_run(run, data_root, longer_edge)
    _check_room(run, checkpoint, image_sizes(benchmarks))
    trained_for = read_provenance(checkpoint).trained_for
    # Gigabytes of parameters are not read for a folder that another run has.
    lock = FolderLock(output, "choose another output")
    try:
        loaded = Checkpoint.load(checkpoint)
        rows = {method: _row(method, loaded, run.settings_of(method), trained_for) for method in run.methods}
        _warn_of_unsuited(trained_for, run.methods)
        timings: Callable[[], Mapping[str, Any]] | None = None
        if run.timings is not None and run.timings.lengths:
            if isinstance(run, PaperRun):
                others = [row for method, row in rows.items() if method != "windows"]
                edge = run.protocol.longer_edge
                timings = functools.partial(
                    measured_timings, loaded, others, run.timings, output, longer_edge=edge, fresh=fresh
                )
            else:
                timings = functools.partial(
                    measured_costs,
                    list(rows.values()),
                    run.timings,
                    output,
                    # Clips' images are of one size, whatever the pictures have.
                    image_size=benchmarks[0].protocol.images.size((3, 4)),
                    dtype=loaded.model.config.dtype,
                    fresh=fresh,
                )
        results = evaluate(
            benchmarks,
            [*rows.values(), *variant_methods(loaded, run.variants), *baselines(loaded.model)],
            output,
            title=run.title,
            command=command,
            configuration=dataclasses.asdict(run),
            checkpoint=loaded.digest,
            max_sequences=run.max_sequences,
            figures=run.figures,
            fresh=fresh,
            timings=timings,
        )
        write_report(results, output)
    finally:
        lock.release()
    return results


def _check_room(run: ClipRun | PaperRun, checkpoint: str | Path, sizes: Sequence[tuple[int, int]]) -> None:
    """Raises InputError for a method whose budget or cap is below one frame of one of these sizes, before any parameter
    is read."""
    config = read_config(resolve(checkpoint))
    for name in run.methods:
        method, settings = METHODS[name], run.settings_of(name)
        for size in sizes:
            method.check(config, size, method.chosen(settings))


def _row(method: str, checkpoint: Checkpoint, settings: Any, trained_for: str | None) -> Method:
    """A row of the model, which says what to expect of weights that are not the method's."""
    row, expected = model_row(method, checkpoint, settings), expectation(trained_for, method)
    return row if expected is None else dataclasses.replace(row, knows=f"{row.knows}; {expected}")


def _warn_of_unsuited(trained_for: str | None, methods: Sequence[str]) -> None:
    """One warning for all methods that the weights were not trained for; beside a method of theirs, plain VGGT is a
    reference."""
    unsuited = [name for name in methods if expectation(trained_for, name)]
    if len(unsuited) < len(methods):
        unsuited = [name for name in unsuited if name not in _REFERENCES]
    if unsuited:
        warnings.warn(
            f"these weights were trained for {trained_for}, not for {', '.join(unsuited)}: expect worse cameras and "
            "depth of these rows; the report says why",
            stacklevel=3,
        )
