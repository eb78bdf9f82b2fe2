"""`logvggt doctor`: what this machine has, and whether the model is right and fast on it."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import Any

from logvggt_jax.cli.choices import METHOD_NAMES
from logvggt_jax.cli.command import add_command
from logvggt_jax.cli.exit_codes import PROBLEMS_FOUND
from logvggt_jax.errors import InputError, disk_errors


def _doctor(options: argparse.Namespace) -> int:
    from logvggt_jax.doctor.examination import ON_REQUEST, QUICK, SHARES, examine, part_findings
    from logvggt_jax.doctor.finding import Finding

    known = (*SHARES, *ON_REQUEST, *METHOD_NAMES)
    if unknown := sorted(set(options.part or ()) - set(known)):
        raise InputError(f"doctor has no part {unknown[0]!r}; it has {', '.join(known)}")
    usual = METHOD_NAMES if options.methods else QUICK if options.quick else tuple(SHARES)
    parts = tuple(dict.fromkeys(options.part or usual))
    marks = {True: "ok", False: "WRONG", None: ""}

    with contextlib.ExitStack() as stack:
        file = None
        if options.json not in (None, "-"):
            with disk_errors(options.json):
                file = stack.enter_context(Path(options.json).open("w"))

        def show(finding: Finding) -> None:
            if file is not None:
                print(finding.to_json(), file=file, flush=True)
            line = (
                f"{finding.part:15} {finding.what:42} {finding.value_text():>20}  {marks[finding.ok]:5} {finding.note}"
            )
            print(finding.to_json() if options.json == "-" else line.rstrip(), flush=True)

        if not options.in_process:
            return 0 if examine(parts, tiny=options.tiny, quick=options.quick, show=show) else PROBLEMS_FOUND
        # Of a part in a process of its own the exit code says whether it ran to its end.
        for part in parts:
            for finding in part_findings(part, tiny=options.tiny, quick=options.quick):
                show(finding)
    return 0


def add_to(commands: Any) -> None:
    """Adds the command."""
    sub = add_command(
        commands,
        "doctor",
        _doctor,
        "what this machine has, whether the model computes right on it, and how fast",
        "logvggt doctor --quick",
        details=" Parts run one after the other, each in a process of its own, five minutes in all and one with "
        "--quick: environment (versions, devices, builds that do not belong together), parity (a small network "
        "against recorded values), inference (kernels, memory, time and utilisation of a step), training (the same "
        "for the training step), whole (from files to files). With --methods each method of `reconstruct --method` is "
        "such a part: its frames a second at VGGT-1B's size, beside what the originals in PyTorch reach on one H100. "
        "`--part precision` compares products in eight bits (`reconstruct --precision`) with those in bfloat16. "
        "On a CPU the model is a tiny one, and nothing is compared. Exit code 0: nothing wrong, 1: something is, "
        "or a part did not come to its end in its time.",
    )
    sub.add_argument("--quick", action="store_true", help="environment, parity and inference alone, in a minute")
    sub.add_argument("--methods", action="store_true", help="every method's frames a second instead of the other parts")
    sub.add_argument(
        "--part", action="append", metavar="NAME", help="this part, or method, alone; may be given several times"
    )
    sub.add_argument("--tiny", action="store_true", help="the tiny model on an accelerator as well")
    sub.add_argument(
        "--json",
        nargs="?",
        const="-",
        metavar="FILE",
        help="write one JSON object a line to a file as well, or print them instead of the table (no file, or -)",
    )
    sub.add_argument("--in-process", action="store_true", help=argparse.SUPPRESS)
