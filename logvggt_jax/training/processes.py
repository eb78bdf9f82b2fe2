"""Several processes that train together, one or more for each machine."""

import hashlib
import json
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from logvggt_jax.errors import InputError

# Steps between two questions whether anybody wants to stop: each costs a round trip over the network.
ASK_EVERY = 10


def join_processes(
    *, coordinator: str | None = None, num_processes: int | None = None, process_id: int | None = None
) -> None:
    """Joins the other processes of this run; before JAX's first use of a device.

    `coordinator` is host:port of process 0, `process_id` counts from 0. None for all three lets JAX ask the cluster:
    Slurm, Open MPI, Kubernetes and TPU pods know the answers. Raises InputError where some of the three are missing, or
    the cluster does not know them.
    """
    given = [value is not None for value in (coordinator, num_processes, process_id)]
    if any(given) and not all(given):
        raise InputError("give all of --coordinator, --num_processes and --process_id, or none of them")
    try:
        jax.distributed.initialize(coordinator, num_processes, process_id)
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"cannot join the other processes ({error}); outside of Slurm, MPI, Kubernetes and TPU pods give "
            "--coordinator=HOST:PORT, --num_processes and --process_id"
        ) from error


def any_process(wants: bool) -> bool:
    """Whether this is true of at least one process; all processes have to ask at the same point."""
    if jax.process_count() == 1:
        return wants
    return bool(np.any(multihost_utils.process_allgather(np.array(wants))))


def check_agreement(what: str, value: Any) -> None:
    """Raises InputError on every process unless `value` (JSON types) is the same on all of them.

    All processes have to ask at the same point.
    """
    if jax.process_count() == 1:
        return
    digest = hashlib.sha256(json.dumps(value, sort_keys=True).encode()).digest()
    rows = multihost_utils.process_allgather(np.frombuffer(digest, np.uint8))
    odd = [process for process, row in enumerate(rows) if not np.array_equal(row, rows[0])]
    if odd:
        raise InputError(
            f"{what} of the processes {odd} differ from those of process 0: let all see the same folders (their logs "
            "name what was left out)"
        )
