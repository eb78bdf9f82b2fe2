"""Runs the parts, each in a process of its own with a time limit, and shows what they find as it comes."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

from logvggt_jax.doctor.finding import UNFINISHED, Finding

# Seconds that each part is sure of, quick and in full: a minute and five minutes together. What one part does not use
# is left to those after it.
SHARES: Mapping[str, tuple[int, int]] = {
    "environment": (10, 10),
    "parity": (20, 40),
    "inference": (30, 50),
    "training": (0, 140),
    "whole": (0, 60),
}
TOTAL = (60, 300)
QUICK = ("environment", "parity", "inference")
# Parts that run where they are asked for.
ON_REQUEST = ("precision",)
# A method of `logvggt_jax.streaming` is a part of its own name. Each is sure of so many seconds, quick and in full, as
# are parts on request.
METHOD_SHARE = (60, 150)


def part_findings(part: str, *, tiny: bool, quick: bool) -> Iterator[Finding]:
    """The findings of one part, in this process."""
    if part == "environment":
        from logvggt_jax.doctor import environment

        yield from environment.examine()
        return
    if part == "parity":
        from logvggt_jax.doctor import parity

        yield from parity.examine()
        return
    from logvggt_jax.doctor import inference, methods, precision, training, whole
    from logvggt_jax.doctor.subject import subject

    modules = {"inference": inference, "training": training, "whole": whole, "precision": precision}
    if part not in modules:
        yield from methods.examine(part, subject(tiny=tiny, quick=quick))
        return
    yield from modules[part].examine(subject(tiny=tiny, quick=quick))


def examine(parts: Sequence[str], *, tiny: bool, quick: bool, show: Callable[[Finding], None]) -> bool:
    """Runs some parts; `show` gets each finding as it comes. Whether nothing is wrong and every part
    came to its end.

    A part that fails or takes too long is a finding of its own, and the others go on.
    """
    sound, column = True, 0 if quick else 1
    shares = [SHARES.get(part, METHOD_SHARE)[column] for part in parts]
    end = time.monotonic() + max(TOTAL[column], sum(shares))
    for index, part in enumerate(parts):
        limit = end - time.monotonic() - sum(shares[index + 1 :])
        for finding in _in_own_process(part, limit, tiny=tiny, quick=quick):
            sound &= finding.ok is not False and finding.value != UNFINISHED
            show(finding)
    return sound


def _in_own_process(part: str, limit: float, *, tiny: bool, quick: bool) -> Iterator[Finding]:
    command = [sys.executable, "-m", "logvggt_jax", "doctor", "--part", part, "--in-process", "--json", "-"]
    command += [option for option, given in (("--tiny", tiny), ("--quick", quick)) if given]
    started = time.monotonic()
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as process,
    ):
        assert process.stdout is not None  # a pipe was asked for
        late = threading.Timer(limit, process.kill)
        late.start()
        try:
            for line in process.stdout:
                with contextlib.suppress(ValueError, TypeError):  # what a library printed
                    yield Finding(**json.loads(line))
            code, over = process.wait(), time.monotonic() - started >= limit
        finally:
            # Also where whoever reads the findings has had enough, or Ctrl-C came.
            late.cancel()
            process.kill()
        errors.seek(0)
        last = next((line.strip() for line in reversed(errors.readlines()) if line.strip()), "no message")
    if code != 0 and over:
        note = f"stopped after its limit of {limit:.0f} s: is the machine busy? --part {part} gives it more time"
        yield Finding(part, "this part", UNFINISHED, note=note)
    elif code != 0:
        yield Finding(part, "this part", "failed", ok=False, note=f"{last:.300}")
    yield Finding(part, "time", time.monotonic() - started, "s")
