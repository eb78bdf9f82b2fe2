"""Several processes that train together, one or more for each machine."""

import contextlib
import hashlib
import json
import os
import platform
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from absl import logging
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from logvggt_jax.errors import InputError, one_line
from logvggt_jax.files import write_text
from logvggt_jax.training.parallel import lifeline
from logvggt_jax.training.parallel.lifeline import Lifeline
from logvggt_jax.training.parallel.sharding import replicated, split

JOIN_SECONDS = 120.0
# The lifeline notices a loss first; these are for where it could not be laid, and for the end of a run.
HEARTBEAT_SECONDS = SHUTDOWN_SECONDS = 60
# A network file system shows a new file to other machines after so long.
SHARED_SECONDS = 60.0
# An operation with the others fails at once when one is lost; so long it takes at most to hear which.
LOSS_SECONDS = 2.0
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
    no others, or (with a warning) where process 0 cannot be reached by a port of its choice.

    Raises InputError where some of the three are missing, or the cluster does not know them.
    """
    given = [value is not None for value in (coordinator, num_processes, process_id)]
    if any(given) and not all(given):
        raise InputError("give all of --coordinator, --num_processes and --process_id, or none of them")
    waited = (
        f"not all {f'of the {num_processes} ' if num_processes else ''}processes joined within {join_seconds:g} s "
        f"(process 0 is to be at {coordinator or 'an address that the cluster gives'}): look at the output of each, "
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
    try:
        if process == 0:
            secret = secrets.token_hex(16)
            with lifeline.listen() as server:
                global_state.client.key_value_set(_LIFELINE_KEY, f"{server.getsockname()[1]} {secret}")
                peers = lifeline.accept(server, secret, count)
        else:
            milliseconds = 1000 * lifeline.CONNECT_SECONDS
            port, secret = global_state.client.blocking_key_value_get(_LIFELINE_KEY, milliseconds).split()
            host = global_state.coordinator_address.rsplit(":", 1)[0].strip("[]")
            peers = lifeline.connect(host, int(port), secret, process)
    except (OSError, jax.errors.JaxRuntimeError) as error:
        logging.warning(
            "processes cannot watch one another (%s): the loss of one is noticed after %d s",
            one_line(error),
            HEARTBEAT_SECONDS,
        )
        return None
    return Lifeline(peers, process=process, on_loss=end_process)


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


def any_process(wants: bool) -> bool:
    """Whether this is true of at least one process; all processes have to ask at the same point."""
    return bool(np.any(from_all(np.array(wants))))


def from_all(values: np.ndarray) -> np.ndarray:
    """The `values` of every process, [processes, …], of one shape; all processes have to ask at the same point."""
    if jax.process_count() == 1:
        return values[None]
    return np.asarray(multihost_utils.process_allgather(values))


class Vote:
    """Whether some process wants to stop, asked in every step without waiting for an answer.

    All processes cast a vote in the same steps, and each reads the answer `delay` steps later, when the devices are
    done with it: so all of them stop after the same step.
    """

    def __init__(self, mesh: Mesh, *, delay: int) -> None:
        self._mesh, self._delay = mesh, delay
        self._any = jax.jit(jnp.any, out_shardings=replicated(mesh))
        self._cast: deque[jax.Array] = deque()

    def __call__(self, wants: bool) -> bool:
        """Casts this step's vote; whether one was for stopping `delay` steps ago. A process alone has its own way."""
        if jax.process_count() == 1:
            return wants
        local = np.full(len(self._mesh.local_devices), wants)
        self._cast.append(self._any(jax.make_array_from_process_local_data(split(self._mesh), local)))
        return len(self._cast) > self._delay and bool(self._cast.popleft())


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


def check_shared(folder: Path) -> None:
    """Raises InputError on every process unless all see the same `folder`, which is made.

    Process 0 writes a token there, and the others have to find it within `SHARED_SECONDS`. All processes have to ask
    at the same point.
    """
    if jax.process_count() == 1:
        return
    drawn = multihost_utils.process_allgather(np.frombuffer(secrets.token_bytes(8), np.uint8))[0]
    token = folder / f".shared-{drawn.tobytes().hex()}"
    failure: InputError | None = None
    try:
        if jax.process_index() == 0:
            folder.mkdir(parents=True, exist_ok=True)
            write_text(token, platform.node())
    except (OSError, InputError) as error:
        failure = InputError(f"{folder}: process 0 cannot write there ({one_line(error)})")
    if any_process(failure is not None):
        raise failure or InputError(f"{folder}: process 0 cannot write there; its output says why")
    seen = _within(SHARED_SECONDS, token.is_file)
    blind = [int(p) for p in np.flatnonzero(~multihost_utils.process_allgather(np.array(seen)).ravel())]
    if jax.process_index() == 0:
        token.unlink(missing_ok=True)
    # A process that ends now ends the others too: not before the token is gone.
    any_process(False)
    if blind:
        raise InputError(
            f"--workdir={folder} of the processes {blind} is another folder than that of process 0, on a disk of "
            "their own machine: name one that all machines share"
        )


def _within(seconds: float, condition: Callable[[], bool]) -> bool:
    """Whether `condition` comes true in time."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.2)
    return True
