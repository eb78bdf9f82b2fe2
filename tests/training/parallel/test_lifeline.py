"""Whoever is lost is named to all, whoever is done to nobody, and strangers are not heard."""

import os
import platform
import queue
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest

from logvggt_jax.training.parallel import lifeline
from logvggt_jax.training.parallel.lifeline import SILENCE_SECONDS, Lifeline, accept, connect, listen

Heard = dict[int, "queue.Queue[str]"]


@pytest.fixture
def three() -> Iterator[tuple[dict[int, Lifeline], dict[int, socket.socket], Heard]]:
    """Three processes' ends of their lifelines, the connections of 1 and 2, and what each one hears of losses."""
    heard: Heard = {process: queue.Queue() for process in range(3)}
    with listen() as server:
        port = server.getsockname()[1]
        accepted: dict[int, socket.socket] = {}
        thread = threading.Thread(target=lambda: accepted.update(accept(server, "secret", 3)))
        thread.start()
        stranger = connect("localhost", port, "guessed", 1)[0]
        peers = {process: connect("localhost", port, "secret", process) for process in (1, 2)}
        thread.join(10)
    stranger.close()
    assert accepted.keys() == {1, 2}
    lines = {0: Lifeline(accepted, process=0, on_loss=heard[0].put)}
    lines |= {process: Lifeline(peer, process=process, on_loss=heard[process].put) for process, peer in peers.items()}
    yield lines, {process: peer[0] for process, peer in peers.items()}, heard
    for line in lines.values():
        line.close()


def test_who_cannot_reach_the_port_costs_the_others_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("logvggt_jax.training.parallel.lifeline.CONNECT_SECONDS", 0.5)
    heard: queue.Queue[str] = queue.Queue()
    with listen() as server:
        peer = connect("localhost", server.getsockname()[1], "secret", 1)
        accepted = accept(server, "secret", 3)
    assert accepted.keys() == {1}
    lines = [Lifeline(accepted, process=0, on_loss=heard.put), Lifeline(peer, process=1, on_loss=heard.put)]
    lines[1].fail("a bug")
    assert heard.get(timeout=10) == f"process 1 on {platform.node()} was lost, it ended with: a bug"
    for line in lines:
        line.close()


def test_the_loss_of_one_is_told_to_all_the_others(three) -> None:  # type: ignore[no-untyped-def]
    _, connections, heard = three
    connections[1].shutdown(socket.SHUT_RDWR)
    expected = f"process 1 on {platform.node()} was lost: it was killed, or its machine is gone"
    assert heard[0].get(timeout=10) == heard[2].get(timeout=10) == expected


def test_who_says_nothing_is_lost_and_who_only_waits_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lifeline, "SILENCE_SECONDS", 2)
    monkeypatch.setattr(lifeline, "_BEAT_SECONDS", 0.5)
    monkeypatch.setattr(lifeline, "_TICK", 0.1)
    heard: queue.Queue[str] = queue.Queue()
    with listen() as server:
        peers = {process: connect("localhost", server.getsockname()[1], "secret", process) for process in (1, 2)}
        accepted = accept(server, "secret", 3)
    first = Lifeline(accepted, process=0, on_loss=heard.put)
    alive = Lifeline(peers[1], process=1, on_loss=heard.put)
    # One whose kernel alone still answers.
    peers[2][0].sendall(b'{"host": "far"}\n')
    told = "process 2 on far was lost: for 2 s it has said nothing, stopped or on a machine that is gone"
    assert heard.get(timeout=10) == told and heard.get(timeout=10) == told, "process 0 and process 1"
    for line in (first, alive):
        line.close()
    peers[2][0].close()


def test_the_reason_of_an_end_is_told(three) -> None:  # type: ignore[no-untyped-def]
    lines, _, heard = three
    lines[2].fail("KeyError: 'x'")
    expected = f"process 2 on {platform.node()} was lost, it ended with: KeyError: 'x'"
    assert heard[0].get(timeout=10) == heard[1].get(timeout=10) == expected
    assert heard[2].empty()


def test_those_that_are_done_are_not_missed(three) -> None:  # type: ignore[no-untyped-def]
    lines, _, heard = three
    lines[1].close()
    lines[2].wait(0.3)
    assert all(losses.empty() for losses in heard.values())
    lines[0].close()
    lines[2].wait(10)
    assert all(losses.empty() for losses in heard.values())


# One of two processes, given its number; it ends as a training run does.
ONE_OF_TWO = """
import sys, time
from logvggt_jax.training.parallel.joining import end_process
from logvggt_jax.training.parallel.lifeline import Lifeline, accept, connect, listen
number, port = map(int, sys.argv[1:])
if number == 0:
    with listen() as server:
        print(server.getsockname()[1], flush=True)
        peers = accept(server, "secret", 2)
else:
    peers = connect("10.99.0.1", port, "secret", number)
Lifeline(peers, process=number, on_loss=end_process)
print("watches", flush=True)
time.sleep(300)
"""


@pytest.fixture
def two_machines() -> Iterator[list[str]]:
    """Names of two network namespaces with a cable between them; the addresses are 10.99.0.1 and 10.99.0.2."""
    if shutil.which("ip") is None:
        pytest.skip("no `ip` that makes network namespaces")
    names = [f"lifeline-{os.getpid()}-{number}" for number in range(2)]

    def ip(*arguments: str) -> None:
        done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"no network namespaces here: ip {' '.join(arguments)}: {done.stderr.strip()}")

    try:
        for name in names:
            ip("netns", "add", name)
        ip("-n", names[0], "link", "add", "cable", "type", "veth", "peer", "name", "cable", "netns", names[1])
        for number, name in enumerate(names, 1):
            ip("-n", name, "address", "add", f"10.99.0.{number}/24", "dev", "cable")
            ip("-n", name, "link", "set", "cable", "up")
        yield names
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)


@pytest.mark.slow
def test_a_machine_that_falls_silent_is_lost_within_the_stated_time(two_machines: list[str]) -> None:
    def start(number: int, port: str) -> "subprocess.Popen[str]":
        command = ["ip", "netns", "exec", two_machines[number], sys.executable, "-c", ONE_OF_TWO, str(number), port]
        return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    first = start(0, "0")
    assert first.stdout is not None
    second = start(1, first.stdout.readline().strip())
    try:
        assert second.stdout is not None
        assert first.stdout.readline() == second.stdout.readline() == "watches\n"
        time.sleep(1)  # until each has the other's name
        # Nobody closes the connection, as where a machine loses its power.
        subprocess.run(["ip", "-n", two_machines[1], "link", "set", "cable", "down"], check=True)
        started = time.monotonic()
        _, errors = first.communicate(timeout=10 * SILENCE_SECONDS)
        assert time.monotonic() - started < SILENCE_SECONDS + 5
        where = f"process 1 on {platform.node()}"
        silent = f"for {SILENCE_SECONDS} s it has said nothing, stopped or on a machine that is gone"
        assert errors == f"train.py: {where} was lost: {silent}\n"
        assert first.returncode == 1
    finally:
        for process in (first, second):
            process.kill()
            process.communicate()
