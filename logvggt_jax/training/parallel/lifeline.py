"""A connection between process 0 and each of the others, whose end tells at once that a process is gone.

JAX's own heartbeats notice it after their time-out, and end the survivors with a trace of C++ that names no host.
"""

from __future__ import annotations

import contextlib
import hmac
import json
import platform
import selectors
import socket
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from logvggt_jax.training.parallel.held_connections import HeldConnections

# A machine that lost its power closes no connection, nor does a process that was stopped: who says nothing for so many
# seconds is lost. JAX's own heartbeats would end the others ten seconds later.
SILENCE_SECONDS = 20
_BEAT_SECONDS = 5.0
# How often it is looked who has said nothing.
_TICK = 1.0
CONNECT_SECONDS = 30
_DONE = "done"


class Lifeline:
    """Watches other processes from a thread, and calls `on_loss` with one line once one of them is lost.

    Process 0 holds a connection to each of the others and passes on to them what it hears; the others hold one to it.

    Args:
      peers: open connections, by the number of the process at their other end.
      process: number of this one.
      on_loss: called at most once, on the thread; a training run ends there.
      held: connections of process 0 that are to outlast it, so that JAX does not end the others before they are told.
    """

    def __init__(
        self,
        peers: Mapping[int, socket.socket],
        *,
        process: int,
        on_loss: Callable[[str], None],
        held: HeldConnections | None = None,
    ) -> None:
        self._peers, self._process, self._on_loss, self._held = dict(peers), process, on_loss, held
        self._closed = False
        self._ended = threading.Event()
        self._sending = threading.Lock()
        self._hosts: dict[int, str] = {}
        for connection in self._peers.values():
            connection.settimeout(None)
        self._send({"host": platform.node()})
        self._thread = threading.Thread(target=self._watch, name="lifeline", daemon=True)
        self._thread.start()
        threading.Thread(target=self._beat, name="lifeline beat", daemon=True).start()

    def fail(self, reason: str) -> None:
        """Tells the others why this process ends before its time."""
        self._closed = True
        self._ended.set()
        self._send({"lost": self._process, "host": platform.node(), "reason": f"was lost, it ended with: {reason}"})

    def wait(self, seconds: float) -> None:
        """Waits for the loss of another process, of which an error here may be the consequence."""
        self._thread.join(seconds)

    def close(self) -> None:
        """Tells the others that this process is done, and stops watching."""
        self._closed = True
        self._ended.set()
        self._send({_DONE: True})
        for connection in self._peers.values():
            # Wakes the thread, which a close alone does not.
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self._thread.join(1)
        for connection in self._peers.values():
            connection.close()
        if self._held is not None:
            self._held.release()

    def _send(self, message: Mapping[str, Any]) -> None:
        line = json.dumps(message).encode() + b"\n"
        for connection in self._peers.values():
            with contextlib.suppress(OSError), self._sending:
                connection.sendall(line)

    def _beat(self) -> None:
        while not self._ended.wait(_BEAT_SECONDS):
            self._send({"alive": True})

    def _watch(self) -> None:
        rest = dict.fromkeys(self._peers, b"")
        last = dict.fromkeys(self._peers, time.monotonic())
        with selectors.DefaultSelector() as selector:
            for process, connection in self._peers.items():
                selector.register(connection, selectors.EVENT_READ, process)
            while selector.get_map() and not self._closed:
                asked = time.monotonic()
                said = selector.select(_TICK)
                now = time.monotonic()
                if now - asked > _TICK + _BEAT_SECONDS:
                    last = dict.fromkeys(last, now)  # this process was stopped itself, and could hear nobody
                for key, _ in said:
                    heard = self._heard(key.data, key.fileobj, rest)
                    last[key.data] = now
                    if self._closed:
                        return
                    if _DONE in heard:
                        selector.unregister(key.fileobj)
                        del last[key.data]
                    elif "lost" in heard:
                        self._lost(heard)
                        return
                for process, time_heard in last.items():
                    if now - time_heard > SILENCE_SECONDS:
                        silent = f"for {SILENCE_SECONDS} s it has said nothing, stopped or on a machine that is gone"
                        self._lost(self._loss(process, f"was lost: {silent}"))
                        return

    def _lost(self, message: dict[str, Any]) -> None:
        self._send(message)
        self._on_loss(f"process {message['lost']} on {message['host']} {message['reason']}")

    def _loss(self, process: int, reason: str) -> dict[str, Any]:
        return {"lost": process, "host": self._hosts.get(process, "an unknown machine"), "reason": reason}

    def _heard(self, process: int, connection: Any, rest: dict[int, bytes]) -> dict[str, Any]:
        """What a process says that ends the watch over it; empty while nothing does."""
        try:
            received = connection.recv(4096)
        except OSError:  # reset, or silent for too long
            received = b""
        if not received:
            return self._loss(process, "was lost: it was killed, or its machine is gone")
        *lines, rest[process] = (rest[process] + received).split(b"\n")
        for message in map(json.loads, lines):
            if "lost" in message or _DONE in message:
                return message
            self._hosts[process] = message.get("host", self._hosts.get(process))
        return {}


def listen() -> socket.socket:
    """A socket at a free port of all of this machine's addresses, for `accept`."""
    if socket.has_dualstack_ipv6():
        return socket.create_server(("", 0), family=socket.AF_INET6, dualstack_ipv6=True)
    return socket.create_server(("", 0))


def accept(server: socket.socket, secret: str, count: int) -> dict[int, socket.socket]:
    """Connections of processes 1 to `count` - 1, which say their number and `secret`; of those that come in time."""
    peers: dict[int, socket.socket] = {}
    end = time.monotonic() + CONNECT_SECONDS
    while len(peers) < count - 1:
        server.settimeout(max(end - time.monotonic(), 0.001))
        try:
            connection, _ = server.accept()
        except TimeoutError:
            break
        connection.settimeout(CONNECT_SECONDS)
        # Whoever else finds the port must not be able to end the run.
        try:
            # Unbuffered: what follows is for `Lifeline`.
            with connection.makefile("rb", buffering=0) as hello:
                number, _, given = hello.readline(200).strip().partition(b" ")
        except OSError:
            given = b""
        if hmac.compare_digest(given, secret.encode()):
            peers[int(number)] = connection
        else:
            connection.close()
    return peers


def connect(host: str, port: int, secret: str, process: int) -> dict[int, socket.socket]:
    """The connection to process 0, which is at `host` and `port`; OSError if it cannot be reached."""
    connection = socket.create_connection((host, port), timeout=CONNECT_SECONDS)
    connection.sendall(f"{process} {secret}\n".encode())
    return {0: connection}
