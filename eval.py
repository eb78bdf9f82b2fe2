"""Evaluates a checkpoint: metrics of depth, poses and points beside honest baselines, as tables and JSON.

    python eval.py --config=configs/eval/rooms.py --checkpoint=runs/tiny/model --output=runs/eval-rooms

    python eval.py --config=configs/eval/paper.py --checkpoint=vggt/model --data_root=data --output=runs/eval-paper

Any field of the configuration can be changed on the command line: --config.options.num_rooms=8. The rows of the model
are chosen by name, the first one is drawn: --config.methods="('windows', 'offline')".
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence

from logvggt_jax.interruption import one_line_at_ctrl_c

with one_line_at_ctrl_c("eval.py"):
    from absl import app, flags

    from logvggt_jax.compile import check_devices, enable_compilation_cache
    from logvggt_jax.errors import InputError, one_line, printable
    from logvggt_jax.evaluation.report.report import print_report
    from logvggt_jax.evaluation.run import run_evaluation
    from logvggt_jax.program_flags import define_config, flags_parser
    from logvggt_jax.terminal import forgiving_streams, one_log_handler, plain_warnings

_CONFIG = define_config("eval.py", "what to evaluate: a file of configs/eval")
_CHECKPOINT = flags.DEFINE_string(
    "checkpoint", None, "model folder, as training and `logvggt convert` write it, or `rooms`, which ships"
)
_OUTPUT = flags.DEFINE_string(
    "output",
    None,
    "folder of the results, new or an evaluation's; an interrupted run goes on, others are replaced once this one is "
    "complete",
)
_DATA_ROOT = flags.DEFINE_string(
    "data_root", None, "folder of the data set, where it is read from disk; for several, the folder of their folders"
)
_FRESH = flags.DEFINE_bool("fresh", False, "measure everything anew, also what the output folder already holds")
_CACHE = flags.DEFINE_string("compilation_cache", None, "folder of compiled programs, `none` for none")


def main(arguments: Sequence[str]) -> None:
    """Evaluates and prints."""
    if len(arguments) > 1:
        raise app.UsageError(f"unknown argument {arguments[1]!r}; settings are given as --config.NAME=VALUE")
    try:
        check_devices()
        enable_compilation_cache(_CACHE.value)
        results = run_evaluation(
            _CONFIG.value.to_dict(),
            _CHECKPOINT.value,
            _OUTPUT.value,
            data_root=_DATA_ROOT.value,
            fresh=_FRESH.value,
            command=shlex.join(["python", *sys.argv]),
        )
    except InputError as error:
        # -v 1 shows where it arose.
        if flags.FLAGS.verbosity > 0:
            raise
        sys.exit(f"eval.py: {one_line(error)}")
    print_report(results)
    print(f"\nTables, JSON and figures are in {printable(_OUTPUT.value)}/; report.html has all of it on one page")


if __name__ == "__main__":
    flags.mark_flags_as_required(["config", "checkpoint", "output"])
    one_log_handler()
    with forgiving_streams(), plain_warnings("eval.py"), one_line_at_ctrl_c("eval.py"):
        app.run(main, flags_parser=flags_parser("eval.py"))
