"""A process in which nothing moves ends with the stacks of its threads; one that works is left alone."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
RUN = """
import time
from logvggt_jax.training.parallel.watchdog import Watchdog
with Watchdog({factor}, least=0.5, other={other}) as watched:
    for _ in range(20):
        time.sleep(0.02)
        watched.step_ended()
    {then}
print("the end", flush=True)
"""


WAITING = "with watched.other('the validation'): time.sleep(2)"
RUNS = {
    "step": ("time.sleep(50)", {}),
    "validation": (WAITING, {}),
    "step after a validation": ("with watched.other('the validation'): pass\n    time.sleep(50)", {}),
    "clips after a stage": ("with watched.other('the save', then_clips=True): pass\n    time.sleep(2)", {}),
    "long validation": (WAITING.replace("2", "50"), {"other": 1.0}),
    # sleep() of a library that is called with the interpreter's lock held.
    "library": ("import ctypes; ctypes.PyDLL(None).sleep(50)", {}),
    "no factor": ("time.sleep(2)", {"factor": 0, "other": 0.1}),
    "longer than a timer counts": ("time.sleep(0.1)", {"factor": "float('inf')"}),
}


@pytest.fixture(scope="module")
def finished() -> dict[str, subprocess.CompletedProcess[str]]:
    """All runs, at once, since they mostly wait."""
    running = {}
    for name, (then, settings) in RUNS.items():
        command = [sys.executable, "-c", RUN.format(**{"factor": 3, "other": 60, "then": then, **settings})]
        pipe = subprocess.PIPE
        running[name] = subprocess.Popen(command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True)
    found = {}
    for name, process in running.items():
        output, error = process.communicate(timeout=60)
        found[name] = subprocess.CompletedProcess(name, process.returncode, output, error)
    return found


Finished = dict[str, subprocess.CompletedProcess[str]]


def test_a_step_that_does_not_end_ends_the_process_with_its_stacks(finished: Finished) -> None:
    ended = finished["step"]
    assert ended.returncode == 1 and "the end" not in ended.stdout
    assert "watchdog: for 0 s no step has ended (the median is 0.0" in ended.stderr
    assert 'File "<string>", line 8 in <module>' in ended.stderr, "the stack of the thread that waits"


def test_a_validation_may_take_longer_than_a_step_but_not_for_ever(finished: Finished) -> None:
    assert finished["validation"].stdout == "the end\n"
    ended = finished["long validation"]
    assert ended.returncode == 1 and "the validation has not ended" in ended.stderr


def test_the_step_after_a_validation_is_a_step(finished: Finished) -> None:
    ended = finished["step after a validation"]
    assert ended.returncode == 1 and "no step has ended since the validation (the median is 0.0" in ended.stderr
    assert finished["clips after a stage"].stdout == "the end\n"


def test_a_library_that_holds_the_interpreter_is_ended_too(finished: Finished) -> None:
    ended = finished["library"]
    assert ended.returncode == 1 and "Timeout" in ended.stderr


def test_without_a_factor_nothing_is_watched(finished: Finished) -> None:
    assert finished["no factor"].returncode == 0 and finished["no factor"].stdout == "the end\n"


def test_a_factor_may_be_as_large_as_one_likes(finished: Finished) -> None:
    assert finished["longer than a timer counts"].stdout == "the end\n", finished["longer than a timer counts"].stderr
