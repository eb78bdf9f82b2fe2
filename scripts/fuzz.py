"""Damages valid inputs of every kind and fails on any outcome other than a result or one line that names the file.

    python scripts/fuzz.py --cases 10000 > failures.jsonl
    python scripts/fuzz.py --kind result --kind trajectory --seed 7 --cases 500

Each failure is a line of JSON on standard output, with the seed that makes it again: the same kind with that seed and
`--cases 1`. What was damaged (flipped, cut, swapped, resized, not a number, another file's content, a pipe, a folder, a
looping link) is in it. A summary goes to standard error; the exit code is 1 where something failed.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Makers of valid inputs lie beside the tests that they serve, as pyproject.toml tells pytest.
for folder in ("", "scripts", "tests/data", "tests/reconstruction", "tests/weights"):
    sys.path.insert(0, str(ROOT / folder))
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
# One thread a worker; more would only be in each other's way.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from fuzzing.kinds import KINDS  # noqa: E402
from fuzzing.pool import run_cases  # noqa: E402


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the cases; 1 where one failed."""
    names = [kind.name for kind in KINDS]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=1000, metavar="N", help="how many (default: 1000)")
    parser.add_argument("--seed", type=int, default=0, help="of the first case; each next one has the next")
    parser.add_argument("--kind", action="append", choices=names, help="this kind alone; may be given several times")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default: 2)")
    parser.add_argument("--limit", type=float, default=20.0, metavar="SECONDS", help="for a case (default: 20)")
    parser.add_argument("--keep", type=Path, default=None, metavar="DIR", help="keep the inputs of failures here")
    options = parser.parse_args(arguments)
    chosen = options.kind or names
    cases = [(chosen[number % len(chosen)], options.seed + number) for number in range(options.cases)]
    counts: Counter[tuple[str, str]] = Counter()
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="fuzz-", ignore_cleanup_errors=True) as folder:
        settings = {"workers": options.workers, "limit": options.limit, "keep": options.keep}
        try:
            for outcome in run_cases(KINDS, cases, Path(folder), **settings):
                counts[outcome.kind, outcome.verdict] += 1
                if outcome.failed:
                    command = f"python scripts/fuzz.py --kind {outcome.kind} --seed {outcome.seed} --cases 1"
                    print(json.dumps({**dataclasses.asdict(outcome), "again": command}), flush=True)
        except KeyboardInterrupt:
            print("interrupted: the cases so far", file=sys.stderr)
    _print_summary(chosen, counts, time.monotonic() - started)
    return any(verdict not in ("result", "line") for _, verdict in counts)


def _print_summary(kinds: Sequence[str], counts: Counter[tuple[str, str]], seconds: float) -> None:
    """A line a kind: how many results, lines, and each form of failure."""
    for kind in dict.fromkeys(kinds):
        verdicts = {verdict: count for (name, verdict), count in sorted(counts.items()) if name == kind}
        right = {name: verdicts.pop(name, 0) for name in ("result", "line")}
        failures = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items()) or "-"
        print(f"{kind:16} {right['result']:6} results {right['line']:6} lines   {failures}", file=sys.stderr)
    total = sum(counts.values())
    failed = sum(count for (_, verdict), count in counts.items() if verdict not in ("result", "line"))
    print(f"{total} cases in {seconds:.0f} s, {failed} failed", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
