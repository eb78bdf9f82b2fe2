"""Evaluates a checkpoint: metrics of depth, poses and points beside honest baselines, as tables and JSON.

    python eval.py --config=configs/eval/rooms.py --checkpoint=runs/tiny/model --output=runs/eval-rooms

    python eval.py --config=configs/eval/paper.py --checkpoint=vggt/model --data_root=data --output=runs/eval-paper

Any field of the configuration can be changed on the command line: --config.rooms.num_rooms=8.
"""

from __future__ import annotations

import dataclasses
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from absl import app, flags, logging
from ml_collections import config_flags

from logvggt_jax.compile import enable_compilation_cache
from logvggt_jax.evaluation.costs.throughput import measured_timings
from logvggt_jax.evaluation.datasets import open_run
from logvggt_jax.evaluation.environment import checkpoint_identity
from logvggt_jax.evaluation.methods.method import network
from logvggt_jax.evaluation.methods.references import reference_methods
from logvggt_jax.evaluation.methods.variants import variant_methods
from logvggt_jax.evaluation.report.report import print_report, write_report
from logvggt_jax.evaluation.runner import evaluate, write_results
from logvggt_jax.evaluation.settings import BenchmarkRun, read_run
from logvggt_jax.weights import load_model

_CONFIG = config_flags.DEFINE_config_file("config", None, "what to evaluate: a file of configs/eval", lock_config=True)
_CHECKPOINT = flags.DEFINE_string("checkpoint", None, "model folder, as training and `logvggt convert` write it")
_OUTPUT = flags.DEFINE_string("output", None, "folder of the results; an interrupted run goes on, others are replaced")
_DATA_ROOT = flags.DEFINE_string(
    "data_root", None, "folder of the data set, where it is read from disk; for several, the folder of their folders"
)
_CACHE = flags.DEFINE_string("compilation_cache", None, "folder of compiled programs, `none` for none")


def main(arguments: Sequence[str]) -> None:
    """Settings, data, model, tables."""
    if len(arguments) > 1:
        raise app.UsageError(f"unknown argument {arguments[1]!r}; settings are given as --config.NAME=VALUE")
    output = Path(_OUTPUT.value)
    try:
        run = read_run(_CONFIG.value.to_dict())
        benchmarks, baselines = open_run(run, _DATA_ROOT.value)
        enable_compilation_cache(_CACHE.value)
        model, variables = load_model(_CHECKPOINT.value)
        references = [] if run.references is None else reference_methods(model, variables, run.references)
        methods = [network(model, variables), *references]
        methods += [*variant_methods(model, variables, run.variants), *baselines(model)]
        identity = checkpoint_identity(_CHECKPOINT.value)
        results = evaluate(
            benchmarks,
            methods,
            output,
            title=run.title,
            command=shlex.join(["python", *sys.argv]),
            configuration=dataclasses.asdict(run),
            identity=identity,
            max_sequences=run.max_sequences,
            figures=run.figures,
        )
        if isinstance(run, BenchmarkRun) and run.timings is not None and run.timings.lengths:
            edge = run.protocol.longer_edge
            results["timings"] = measured_timings(
                model, variables, references, run.timings, output, longer_edge=edge, identity=identity
            )
            write_results(results, output)
        write_report(results, output)
    except (ValueError, OSError, ImportError) as error:
        # Errors of settings, data and checkpoints say in one line what to mend; -v 1 shows where they arose.
        if flags.FLAGS.verbosity > 0:
            raise
        sys.exit(f"eval.py: {' '.join(str(error).split())}")
    print_report(results)
    print(f"\nTables, JSON and figures are in {output}/; report.html has all of it on one page")


def parse_flags(arguments: list[str]) -> list[str]:
    """Flags as absl reads them, with an unknown configuration field as one line."""
    try:
        rest = app.parse_flags_with_usage(arguments)
    except (AttributeError, KeyError) as error:
        # The library wraps one error in the other, with quotes around quotes.
        reason = error.args[0] if error.args else error
        reason = reason.args[0] if isinstance(reason, KeyError) else reason
        sys.exit(f"eval.py: --config has no such field: {' '.join(str(reason).split())}")
    except OSError as error:
        sys.exit(f"eval.py: {' '.join(str(error).split())}")
    if flags.FLAGS["verbosity"].using_default_value:
        # Orbax reports every file at the level that absl's app would choose.
        flags.FLAGS.verbosity = logging.WARNING
    return rest


if __name__ == "__main__":
    flags.mark_flags_as_required(["config", "checkpoint", "output"])
    app.run(main, flags_parser=parse_flags)
