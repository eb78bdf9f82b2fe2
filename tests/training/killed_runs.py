"""A run of `train.py` that is killed at one step, however fast the machine is."""

from __future__ import annotations

import signal
import time
from pathlib import Path

from root_programs import Running


def standing_still(step: int) -> str:
    """What a program does first, so that its run stands still once the line of this step is written."""
    return f"""
import time
from logvggt_jax.training import loop
write = loop.MetricsLog.write
def stand_still(log, step, *given, **words):
    write(log, step, *given, **words)
    if step == {step}:
        time.sleep(600)
loop.MetricsLog.write = stand_still
"""


def kill(run: Running, workdir: Path, *, step: int, saved: int) -> None:
    """Kills a run that stands still after `step` once the checkpoint of step `saved` is there."""
    written, checkpoint = workdir / "metrics.jsonl", workdir / "checkpoints" / str(saved)
    line, end = b'{"step": %d,' % step, time.monotonic() + 300
    while not (checkpoint.is_dir() and line in written.read_bytes()):
        assert time.monotonic() < end, run.error.read_text()
        time.sleep(0.02)
    run.send_signal(signal.SIGKILL)
    assert run.wait() == -signal.SIGKILL
