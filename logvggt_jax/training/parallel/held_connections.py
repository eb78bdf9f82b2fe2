"""The coordinator's connections to the other processes, kept open for a moment after process 0 is killed.

The coordinator lives in process 0, and JAX ends a process with a trace of C++ as soon as its connection to it closes. A
connection closes with the last process that holds it: a second one, which does nothing else, gives the others the time
to say in a line who is gone. Where both end at once, with their container or job, the trace may still come.
"""

from __future__ import annotations

import contextlib
import os
import stat
import subprocess
from pathlib import Path
from socket import socket

# The lifeline needs milliseconds; the rest is room for a busy machine.
_SECONDS = 5
_OPEN_FILES = Path("/dev/fd")


class HeldConnections:
    """All connections that others have made to a port of this process; does nothing where there is no shell.

    Args:
      port: of the coordinator, once all have joined.
    """

    def __init__(self, port: int) -> None:
        self._holder: subprocess.Popen[bytes] | None = None
        # Its input ends with this process, however that ends.
        with contextlib.suppress(OSError):
            self._holder = subprocess.Popen(
                ["sh", "-c", f"cat; exec sleep {_SECONDS}"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=_connections(port),
                # What a terminal sends to this process is not for it.
                start_new_session=True,
            )

    def release(self) -> None:
        """They close with this process from now on."""
        if self._holder is not None:
            self._holder.kill()
            self._holder.communicate()


def _connections(port: int) -> list[int]:
    found = []
    for entry in _OPEN_FILES.iterdir():
        with contextlib.suppress(OSError):  # the listing's own, and those that another thread closes meanwhile
            number = int(entry.name)
            if stat.S_ISSOCK(os.fstat(number).st_mode) and _is_connected(number, port):
                found.append(number)
    return found


def _is_connected(number: int, port: int) -> bool:
    """Whether this open socket is a connection that was made to the `port`; OSError for one that waits for them."""
    with socket(fileno=os.dup(number)) as connection:
        own = connection.getsockname()
        return isinstance(own, tuple) and own[1] == port and bool(connection.getpeername())
