"""Whoever is lost is named to all, whoever is done to nobody, and strangers are not heard."""

import platform
import queue
import socket
import threading
from collections.abc import Iterator

import pytest

from logvggt_jax.training.parallel.lifeline import Lifeline, accept, connect, listen

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
