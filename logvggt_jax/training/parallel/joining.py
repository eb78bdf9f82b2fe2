"""How the processes of a run find one another, one or more on each machine, and end together."""

import contextlib
import os
import re
import secrets
import threading

import jax
from absl import logging

from logvggt_jax.errors import InputError, one_line
from logvggt_jax.training.parallel import lifeline
from logvggt_jax.training.parallel.held_connections import HeldConnections
from logvggt_jax.training.parallel.lifeline import Lifeline

JOIN_SECONDS = 120.0
# The lifeline notices a loss first; these are for where it could not be laid, and for the end of a run.
HEARTBEAT_SECONDS = SHUTDOWN_SECONDS = 60
# An operation with the others fails at once when one is lost; so long it takes at most to hear which.
LOSS_SECONDS = 2.0
# A process that has an error ends its reading processes before it tells the others.
ENDING_SECONDS = 30.0
_LIFELINE_KEY = "logvggt/lifeline"


def join_processes(
    *,
    coordinator: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
    join_seconds: float = JOIN_SECONDS,
) -> Lifeline | None:
    """Joins the other processes of this run; before JAX's first use of a device.

    `coordinator` is host:port of process 0, `process_id` counts from 0. None for all three lets JAX ask the cluster:
    Slurm, Open MPI, Kubernetes and TPU pods know the answers. Where the others have not come after `join_seconds`, the
    process ends with a line that says so.

    Returns what watches the others, and ends this process with one line when one of them is lost; None where there are
    no others, or (with a warning) where this process cannot reach process 0 by a port of its choice.

    Raises InputError where some of the three are missing or have another form, or the cluster does not know them.
    """
    given = [value is not None for value in (coordinator, num_processes, process_id)]
    if any(given) and not all(given):
        raise InputError("give all of --coordinator, --num_processes and --process_id, or none of them")
    if coordinator is not None and not re.fullmatch(r".+:\d+", coordinator):
        raise InputError(f"--coordinator={coordinator}: expected HOST:PORT, a free port of the machine of process 0")
    waited = (
        f"not all {f'of the {num_processes} ' if num_processes else ''}processes joined within {join_seconds:g} s "
        f"(process 0 is to be at {coordinator or 'an address that the cluster gives'}): look at the output of each, "
        f"{'' if process_id is None else 'give each a --process_id of its own, '}"
        "and give --join_seconds where machines start later than that"
    )
    # JAX would end the process itself, with a trace.
    timer = threading.Timer(join_seconds, lambda: end_process(waited))
    timer.daemon = True
    timer.start()
    try:
        jax.distributed.initialize(
            coordinator,
            num_processes,
            process_id,
            initialization_timeout=int(join_seconds) + 60,
            heartbeat_timeout_seconds=HEARTBEAT_SECONDS,
            shutdown_timeout_seconds=SHUTDOWN_SECONDS,
        )
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"cannot join the other processes ({error}); outside of Slurm, MPI, Kubernetes and TPU pods give "
            "--coordinator=HOST:PORT, --num_processes and --process_id"
        ) from error
    finally:
        timer.cancel()
    return _lifeline()


def _lifeline() -> Lifeline | None:
    # The address and the store of keys that JAX's processes share have no public name.
    from jax._src.distributed import global_state

    process, count = global_state.process_id, global_state.num_processes
    if count == 1:
        return None
    assert global_state.client is not None and global_state.coordinator_address is not None
    host, coordinator_port = global_state.coordinator_address.rsplit(":", 1)
    try:
        if process == 0:
            secret = secrets.token_hex(16)
            with lifeline.listen() as server:
                global_state.client.key_value_set(_LIFELINE_KEY, f"{server.getsockname()[1]} {secret}")
                peers = lifeline.accept(server, secret, count)
            if absent := sorted({*range(1, count)} - {*peers}):
                logging.warning(
                    "processes %s cannot reach a port that process 0 has chosen: the loss of one of these is noticed "
                    "after %d s",
                    ", ".join(map(str, absent)),
                    HEARTBEAT_SECONDS,
                )
        else:
            milliseconds = 1000 * lifeline.CONNECT_SECONDS
            port, secret = global_state.client.blocking_key_value_get(_LIFELINE_KEY, milliseconds).split()
            peers = lifeline.connect(host.strip("[]"), int(port), secret, process)
    except (OSError, jax.errors.JaxRuntimeError) as error:
        logging.warning(
            "processes cannot watch one another (%s): the loss of one is noticed after %d s",
            one_line(error),
            HEARTBEAT_SECONDS,
        )
        return None
    held = HeldConnections(int(coordinator_port)) if process == 0 else None
    return Lifeline(peers, process=process, on_loss=end_process, held=held)


def end_process(message: str) -> None:
    """Says one line and ends this process at once: its other threads may wait for another process for ever."""
    # In one piece, and without the locks of a stream that a thread may hold for ever.
    with contextlib.suppress(OSError):
        os.write(2, f"train.py: {message}\n".encode())
    os._exit(1)


def check_processes() -> None:
    """Warns where one process owns several GPUs and is not alone."""
    if jax.process_count() > 1 and jax.default_backend() == "gpu" and jax.local_device_count() > 1:
        logging.warning(
            "process %d owns %d GPUs beside %d other processes, in which JAX 0.11.0 can wait for ever (a deadlock in "
            "NCCL); start one process a GPU, for example with srun --ntasks-per-node=%d --gpus-per-node=%d",
            jax.process_index(),
            jax.local_device_count(),
            jax.process_count() - 1,
            jax.local_device_count(),
            jax.local_device_count(),
        )
