"""Trains LoG-VGGT.

    python train.py --config=configs/tiny.py --workdir=runs/tiny

Run the same command again to go on after an interruption. On several machines start it on each of them with
--distributed (docs/clusters.md). With --dry_run nothing is trained: the step of every stage and size is compiled, and
what it needs is printed. With --preflight the same command tries network, data, folder and step beforehand. Any field
of the configuration can be changed on the command line: --config.optimizer.learning_rate=5e-4; other data with
--source=tum_recording=/data/mine,frames=:700 and --validation_source=tum_recording=/data/mine,frames=-200: (see
docs/own-sequences.md).
"""

from __future__ import annotations

import os
import platform
import sys
import traceback
from collections.abc import Sequence
from typing import NoReturn

from logvggt_jax.interruption import INTERRUPTED, one_line_at_ctrl_c

with one_line_at_ctrl_c("train.py"):
    import jax
    from absl import app, flags

    from logvggt_jax.compile import check_devices, check_nccl, enable_compilation_cache
    from logvggt_jax.errors import InputError, one_line
    from logvggt_jax.files import user_path
    from logvggt_jax.program_flags import define_config, flags_parser
    from logvggt_jax.terminal import forgiving_streams, one_log_handler, plain_warnings
    from logvggt_jax.training.config import TrainConfig
    from logvggt_jax.training.dry_run import described_mesh, dry_run
    from logvggt_jax.training.loop import NonFiniteTraining, train
    from logvggt_jax.training.parallel.agreement import EndedElsewhere
    from logvggt_jax.training.parallel.joining import (
        ENDING_SECONDS,
        JOIN_SECONDS,
        LOSS_SECONDS,
        check_processes,
        join_processes,
    )
    from logvggt_jax.training.parallel.lifeline import Lifeline
    from logvggt_jax.training.parallel.sharding import data_mesh, use_cpu_cores
    from logvggt_jax.training.preflight import preflight
    from logvggt_jax.training.reporting.profile import ProfiledSteps
    from logvggt_jax.training.source_text import with_sources

_CONFIG = define_config("train.py", "File with the run's settings.")
_SOURCES = flags.DEFINE_multi_string(
    "source", [], "Data to train on instead of the configuration's: NAME=FOLDER,split=…,frames=FIRST:STOP; repeatable."
)
_VALIDATION_SOURCES = flags.DEFINE_multi_string(
    "validation_source", [], "Data to validate on instead of the configuration's, in the same way; `none` for none."
)
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder for checkpoints, the model and logs.")
_RESUME_STEP = flags.DEFINE_integer(
    "resume_step", None, "Checkpoint to go back to, once; later ones are moved aside. By default the latest."
)
_DISTRIBUTED = flags.DEFINE_bool(
    "distributed", False, "This is one of several processes; start the same command once on every machine."
)
_COORDINATOR = flags.DEFINE_string("coordinator", None, "host:port of process 0, where the cluster does not say.")
_NUM_PROCESSES = flags.DEFINE_integer("num_processes", None, "Processes of the run, where the cluster does not say.")
_PROCESS_ID = flags.DEFINE_integer("process_id", None, "Of this process, from 0, where the cluster does not say.")
_JOIN_SECONDS = flags.DEFINE_float("join_seconds", JOIN_SECONDS, "How long to wait for the others at the start.")
_WATCHDOG = flags.DEFINE_float(
    "watchdog",
    30.0,
    "End the process, with all stacks, when no step ended in so many median steps; 0: never.",
    lower_bound=0.0,
)
_PROFILE = flags.DEFINE_string("profile", None, "Steps to write a trace of to WORKDIR/profile, such as 20:25.")
_WANDB = flags.DEFINE_string(
    "wandb", None, "Project of Weights & Biases to show the run in (WANDB_MODE=offline works)."
)
_DRY_RUN = flags.DEFINE_bool("dry_run", False, "Say what every step needs and how many clips fit; train nothing.")
_PREFLIGHT = flags.DEFINE_bool("preflight", False, "Try network, data, folder and step in minutes; train nothing.")
_DESCRIBED = flags.DEFINE_string(
    "described", None, "Devices to compile for in place of those at hand, such as v5p:2x2x4 or h100:16; with --dry_run."
)
_CACHE = flags.DEFINE_string(
    "compilation_cache",
    None,
    "Folder that keeps compiled programs, `none` for none; by default the user's cache. Not for --described.",
)


def main(arguments: Sequence[str]) -> None:
    """Settings, devices, training."""
    if len(arguments) > 1:
        sys.exit(f"train.py: unknown argument {arguments[1]!r}; settings are given as --config.NAME=VALUE")
    watched: Lifeline | None = None
    try:
        # What is compiled for devices that are not here cannot be read back.
        enable_compilation_cache("none" if _DESCRIBED.value else _CACHE.value)
        config = TrainConfig.from_dict(with_sources(_CONFIG.value.to_dict(), _SOURCES.value, _VALIDATION_SOURCES.value))
        profile = ProfiledSteps.parse(_PROFILE.value) if _PROFILE.value else None
        use_cpu_cores(config, num_processes=_NUM_PROCESSES.value or 1)
        check_nccl()
        apart = (_COORDINATOR, _NUM_PROCESSES, _PROCESS_ID, _JOIN_SECONDS)
        if not (_WORKDIR.value is None or _WORKDIR.value.strip()):
            raise InputError("--workdir is empty: name a folder, which is made if need be")
        if _PREFLIGHT.value and _DRY_RUN.value:
            raise InputError("--preflight tries what --dry_run only compiles: give one of them")
        if given := [flag for flag in apart if flag.present and not _DISTRIBUTED.value]:
            raise InputError(f"--{given[0].name} is of runs of several processes: add --distributed, or leave it out")
        if _DISTRIBUTED.value:
            watched = join_processes(
                coordinator=_COORDINATOR.value,
                num_processes=_NUM_PROCESSES.value,
                process_id=_PROCESS_ID.value,
                join_seconds=_JOIN_SECONDS.value,
            )
        check_devices()
        check_processes()
        if _DRY_RUN.value:
            dry_run(config, described_mesh(_DESCRIBED.value) if _DESCRIBED.value else data_mesh())
        elif _PREFLIGHT.value:
            preflight(config, user_path(_WORKDIR.value), data_mesh())
        else:
            train(
                config,
                user_path(_WORKDIR.value),
                mesh=data_mesh(),
                resume_step=_RESUME_STEP.value,
                watchdog=_WATCHDOG.value,
                profile=profile,
                wandb=_WANDB.value,
            )
    except BaseException as error:
        _fail(error, watched)
    if watched is not None:
        watched.close()


def _fail(error: BaseException, watched: Lifeline | None) -> NoReturn:
    """Ends this process with what a user can mend in one line (-v 1 shows where it arose), else with a traceback."""
    # JAX counts processes with the help of a back end, which may be what does not start.
    several = jax.distributed.is_initialized()
    if isinstance(error, InputError | NonFiniteTraining) and flags.FLAGS.verbosity <= 0:
        message = f"train.py: {one_line(error)}"
    elif isinstance(error, KeyboardInterrupt) and flags.FLAGS.verbosity <= 0:
        message = "train.py: interrupted; the same command goes on from the last checkpoint, if there is one"
    elif several or isinstance(error, KeyboardInterrupt):
        message = "".join(traceback.format_exception(error))
    else:
        raise error
    if several:
        if watched is not None:
            # The lifeline says in a line what became of another process, which is most often why.
            if isinstance(error, jax.errors.JaxRuntimeError):
                watched.wait(LOSS_SECONDS)
            elif isinstance(error, EndedElsewhere):
                watched.wait(ENDING_SECONDS)
            watched.fail(f"{type(error).__name__}: {one_line(error):.500}")
        # At once: the others wait for this process's share of a step, and it would wait for them at the exit.
        print(f"process {os.getpid()} on {platform.node()}: {message}", file=sys.stderr, flush=True)
        os._exit(1)
    if isinstance(error, KeyboardInterrupt):
        print(message, file=sys.stderr)
        sys.exit(INTERRUPTED)
    sys.exit(message)


if __name__ == "__main__":
    flags.mark_flag_as_required("config")
    flags.register_multi_flags_validator(
        ["workdir", "dry_run", "described"],
        lambda given: given["dry_run"] or (given["workdir"] is not None and given["described"] is None),
        "a run needs --workdir; --described goes with --dry_run",
    )
    one_log_handler()
    with forgiving_streams(), plain_warnings("train.py"), one_line_at_ctrl_c("train.py"):
        app.run(main, flags_parser=flags_parser("train.py"))
