"""What processes that train together have to agree on: all ask at the same point, and all hear the same.

A process alone agrees with itself, at once.
"""

import hashlib
import json
import platform
import secrets
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from logvggt_jax.errors import InputError, one_line
from logvggt_jax.files import write_text
from logvggt_jax.training.parallel.sharding import replicated, split

# A network file system shows a new file to other machines after so long.
SHARED_SECONDS = 60.0
# Others may still wait for the clips of a step that this process has begun already.
ANSWER_SECONDS = 60.0
_SAME_FOLDERS = "let all see the same folders (their logs name what was left out)"


class EndedElsewhere(InputError):
    """The run ends for an error of another process, which says there what it is."""


def any_process(wants: bool) -> bool:
    """Whether this is true of at least one process; all processes have to ask at the same point."""
    return bool(np.any(from_all(np.array(wants))))


def from_all(values: np.ndarray) -> np.ndarray:
    """The `values` of every process, [processes, …], of one shape; all processes have to ask at the same point."""
    if jax.process_count() == 1:
        return values[None]
    return np.asarray(multihost_utils.process_allgather(values))


def texts_from_all(text: str) -> list[str]:
    """The `text` of every process; all processes have to ask at the same point."""
    own = np.frombuffer(text.encode(), np.uint8)
    lengths = from_all(np.array(own.size))
    padded = from_all(np.pad(own, (0, int(lengths.max()) - own.size)))
    return [row[:length].tobytes().decode() for row, length in zip(padded, lengths, strict=True)]


def raise_together(failure: BaseException | None, what: str) -> None:
    """Raises this process's `failure`, or EndedElsewhere where only others have one; all processes have to ask at the
    same point. `what` says of a process that it fails, in words."""
    failed = np.flatnonzero(from_all(np.array(failure is not None)))
    if failure is not None:
        raise failure
    if failed.size:
        raise EndedElsewhere(f"{', '.join(f'process {process}' for process in failed)} {what}; its output says why")


class Exchange:
    """What processes tell one another without their devices: they may do so at different points between their steps,
    and none waits for ever. There is one exchange of a `name` in the life of the processes."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._last: str | None = None

    def __call__(self, number: int, text: str) -> list[str | None]:
        """The `text` of every process for this `number`, which none gives twice; None of a process that has not given
        its own within `ANSWER_SECONDS`."""
        if jax.process_count() == 1:
            return [text]
        # The store of keys that JAX's processes share has no public name.
        from jax._src.distributed import global_state

        assert global_state.client is not None
        key, end = f"logvggt/{self._name}/{number}", time.monotonic() + ANSWER_SECONDS
        own = f"{key}/{jax.process_index()}"
        global_state.client.key_value_set(own, text)
        texts: list[str | None] = []
        for process in range(jax.process_count()):
            if process == jax.process_index():
                texts.append(text)
                continue
            # One that is silent leaves the others, who have answered long ago, time to be heard.
            milliseconds = max(int(1000 * (end - time.monotonic())), 2000)
            try:
                texts.append(global_state.client.blocking_key_value_get(f"{key}/{process}", milliseconds))
            except jax.errors.JaxRuntimeError:
                texts.append(None)
        # Whoever has spoken now has heard what was said before.
        if self._last is not None:
            global_state.client.key_value_delete(self._last)
        self._last = own
        return texts


class Vote:
    """Whether some process wants to stop, asked in every step without waiting for an answer.

    All processes cast a vote in the same steps, and each reads the answer `delay` steps later, when the devices are
    done with it: so all of them stop after the same step.

    Attributes:
      notice: steps that follow the one in whose vote a process was for stopping, and that it has to take part in.
    """

    def __init__(self, mesh: Mesh, *, delay: int) -> None:
        self._mesh = mesh
        self.notice = 0 if jax.process_count() == 1 else delay
        self._any = jax.jit(jnp.any, out_shardings=replicated(mesh))
        self._cast: deque[jax.Array] = deque()

    def __call__(self, wants: bool) -> bool:
        """Casts this step's vote; whether one was for stopping `notice` steps ago. A process alone has its own way."""
        if jax.process_count() == 1:
            return wants
        local = np.full(len(self._mesh.local_devices), wants)
        self._cast.append(self._any(jax.make_array_from_process_local_data(split(self._mesh), local)))
        return len(self._cast) > self.notice and bool(self._cast.popleft())


def check_agreement(what: str, value: Any, *, mend: str = _SAME_FOLDERS) -> None:
    """Raises InputError on every process unless `value` (JSON types) is the same on all of them; it ends with `mend`.

    All processes have to ask at the same point.
    """
    if jax.process_count() == 1:
        return
    digest = hashlib.sha256(json.dumps(value, sort_keys=True).encode()).digest()
    rows = multihost_utils.process_allgather(np.frombuffer(digest, np.uint8))
    odd = [process for process, row in enumerate(rows) if not np.array_equal(row, rows[0])]
    if odd:
        raise InputError(f"{what} of the processes {odd} differ from those of process 0: {mend}")


def check_shared(folder: Path, setting: str = "--workdir") -> None:
    """Raises InputError on every process unless all see the same `folder`, the value of `setting`, which is made.

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
            f"{setting}={folder} of the processes {blind} is another folder than that of process 0, on a disk of "
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
