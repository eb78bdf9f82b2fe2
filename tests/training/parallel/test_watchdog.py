"""A process in which nothing moves ends with the stacks of its threads; one that works is left alone."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
RUN = """
import time
from logvggt_jax.training.parallel.watchdog import Watchdog
with Watchdog(3, least=0.1, other={other}) as watched:
    for _ in range(20):
        time.sleep(0.02)
        watched.step_ended()
    {then}
print("the end", flush=True)
"""


def run(then: str, other: float = 60) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", RUN.format(other=other, then=then)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)


def test_a_step_that_does_not_end_ends_the_process_with_its_stacks() -> None:
    finished = run("time.sleep(50)")
    assert finished.returncode == 1 and "the end" not in finished.stdout
    assert "watchdog: for 0 s no step has ended (the median is 0.02" in finished.stderr
    assert 'File "<string>", line 8 in <module>' in finished.stderr, "the stack of the thread that waits"


def test_a_validation_may_take_longer_than_a_step_but_not_for_ever() -> None:
    waiting = "with watched.other('the validation'): time.sleep(2)"
    assert run(waiting).stdout == "the end\n"
    finished = run(waiting, other=1.0)
    assert finished.returncode == 1 and "the validation has not ended" in finished.stderr


def test_a_library_that_holds_the_interpreter_is_ended_too() -> None:
    # sleep() of a library that is called with the interpreter's lock held.
    finished = run("import ctypes; ctypes.PyDLL(None).sleep(50)")
    assert finished.returncode == 1 and "Timeout" in finished.stderr


def test_without_a_factor_nothing_is_watched() -> None:
    command = [sys.executable, "-c", RUN.replace("Watchdog(3", "Watchdog(0").format(other=0.1, then="time.sleep(2)")]
    assert subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout == "the end\n"
