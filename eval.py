"""Evaluates a checkpoint: metrics of depth, poses and points beside honest baselines, as tables and JSON.

python eval.py --config=configs/eval/rooms.py --checkpoint=runs/tiny/model --output=runs/eval-rooms
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from absl import app, flags, logging
from ml_collections import config_flags

from logvggt_jax.evaluation.baselines import all_baselines
from logvggt_jax.evaluation.datasets import open_evaluation_set
from logvggt_jax.evaluation.methods import network
from logvggt_jax.evaluation.report import print_report, write_report
from logvggt_jax.evaluation.runner import EvaluationConfig, evaluate
from logvggt_jax.weights import load_model

_CONFIG = config_flags.DEFINE_config_file("config", None, "what to evaluate: a file of configs/eval", lock_config=True)
_CHECKPOINT = flags.DEFINE_string("checkpoint", None, "model folder, as training and `logvggt convert` write it")
_OUTPUT = flags.DEFINE_string("output", None, "folder of the results; those of an earlier run are replaced")
_DATA_ROOT = flags.DEFINE_string("data_root", None, "folder of the data set, where it is read from disk")
flags.mark_flags_as_required(["config", "checkpoint", "output"])


def main(argv: Sequence[str]) -> None:
    if len(argv) > 1:
        raise app.UsageError(f"unexpected arguments: {' '.join(argv[1:])}")
    logging.set_verbosity(logging.WARNING)
    config, output = _CONFIG.value, Path(_OUTPUT.value)
    try:
        settings = EvaluationConfig.from_dict(config.evaluation)
        dataset, known_set, known = open_evaluation_set(
            config.dataset,
            _DATA_ROOT.value,
            split=config.split,
            image_size=settings.image_size,
            rooms=config.get("rooms"),
        )
        model, variables = load_model(_CHECKPOINT.value)
        methods = [network(model, variables)]
        if config.baselines:
            methods += all_baselines(model, known_set, settings.image_size, source=known, seed=settings.seed)
        command = shlex.join(["python", *sys.argv])
        results = evaluate(dataset, methods, settings, output, title=config.title, command=command)
        write_report(results, output / "report.md")
    except (ValueError, OSError, ImportError) as error:
        raise SystemExit(f"eval.py: {error}") from error
    print_report(results)
    print(f"\nTables, JSON and figures are in {output}/")


if __name__ == "__main__":
    app.run(main)
