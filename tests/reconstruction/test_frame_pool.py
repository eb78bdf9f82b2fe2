"""Threads beside the feeding one: results in order, little ahead, errors where they belong."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from logvggt_jax.reconstruction.frame_pool import FramePool


@pytest.mark.parametrize("workers", [1, 4])
def test_results_are_in_order_however_long_each_takes(workers: int) -> None:
    def work(number: int) -> int:
        time.sleep(0.002 * (number % 3))
        return number * number

    with FramePool(workers) as pool:
        assert list(pool.map(work, iter(range(30)))) == [number * number for number in range(30)]
        assert list(pool.map(work, iter([]))) == []


def test_items_are_drawn_one_at_a_time_and_not_far_ahead() -> None:
    drawn: list[int] = []
    threads: set[int] = set()

    def numbers() -> Iterator[int]:
        for number in range(50):
            drawn.append(number)
            threads.add(threading.get_ident())
            yield number

    with FramePool(2) as pool:
        for done, _ in enumerate(pool.map(lambda number: number, numbers())):
            assert len(drawn) <= done + 1 + 6
    assert len(drawn) == 50
    assert len(threads) == 1 and threading.get_ident() not in threads


def test_several_items_are_at_work_at_once() -> None:
    together = threading.Barrier(3)
    with FramePool(3) as pool:
        assert len(list(pool.map(lambda _: together.wait(timeout=10), iter(range(3))))) == 3


@pytest.mark.parametrize("who", ["items", "function"])
def test_an_error_is_raised_in_its_place(who: str) -> None:
    def numbers() -> Iterator[int]:
        for number in range(20):
            if who == "items" and number == 4:
                raise KeyError("frame 4")
            yield number

    def work(number: int) -> int:
        if who == "function" and number == 4:
            raise KeyError("frame 4")
        return number

    seen = []
    with pytest.raises(KeyError, match="frame 4"), FramePool(3) as pool:
        for number in pool.map(work, numbers()):
            seen.append(number)
    assert seen == [0, 1, 2, 3]


def test_a_call_that_fails_stops_those_who_submit_and_drops_what_waits() -> None:
    begun: list[int] = []

    def write(number: int) -> None:
        begun.append(number)
        time.sleep(0.001)
        if number == 2:
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"), FramePool(1) as pool:
        for number in range(1000):
            pool.submit(write, number)
    assert len(begun) < 20


def test_submitting_waits_while_too_much_is_waiting() -> None:
    done: list[int] = []
    with FramePool(1) as pool:
        for number in range(40):
            pool.submit(lambda n: (time.sleep(0.001), done.append(n)), number)
            assert number + 1 - len(done) <= 8
        pool.finish()
        assert done == list(range(40))


def test_the_last_calls_error_is_raised_at_the_end() -> None:
    def fail() -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"), FramePool(1) as pool:
        pool.submit(fail)
        pool.finish()
