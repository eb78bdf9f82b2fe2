"""The text of a compiled program: what its computations hold, and how often each of them runs."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict

_COMPUTATION = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\) -> .* \{$")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"')
_LOOP = re.compile(r"\bbody=%?([\w.\-]+)")
_CALL = re.compile(r" call\(.*\bto_apply=%?([\w.\-]+)")
_FUSED = re.compile(r"\bcalls=%?([\w.\-]+)")
_CONDITION = re.compile(r"\b(?:true_computation|false_computation|branch_computations)=(\{[^}]*\}|[^\s,]+)")
_NAME = re.compile(r"%?([\w.\-]+)")
_ARRAY = re.compile(r"([a-z]+)(\d*)[a-z0-9]*\[([\d,]*)\]")


class ProgramText:
    """What `jax.stages.Compiled.as_text` gives.

    Attributes:
      lines: of every computation by its name: one for each instruction.
    """

    def __init__(self, text: str) -> None:
        self.lines: dict[str, list[str]] = defaultdict(list)
        self._entry = name = ""
        # Wide tuples are numbered in comments.
        for line in re.sub(r"/\*.*?\*/", "", text).splitlines():
            if match := _COMPUTATION.match(line):
                name = match[2]
                self._entry = name if match[1] else self._entry
            elif name and line.startswith("  ") and " = " in line:
                self.lines[name].append(line)

    def runs(self, *, fused: bool = True) -> dict[str, int]:
        """How often each computation runs, those that are `fused` into one kernel or not.

        A loop's counts as often as it runs where the program says how often that is, else once; of the branches of a
        condition the longest one alone.
        """
        runs: Counter[str] = Counter()

        def run(name: str, times: int) -> None:
            runs[name] += times
            for line in self.lines[name]:
                trips = _TRIPS.search(line)
                called = [*_LOOP.findall(line), *_CALL.findall(line), *(_FUSED.findall(line) if fused else ())]
                if branches := _NAME.findall(" ".join(_CONDITION.findall(line))):
                    called.append(max(branches, key=lambda branch: len(self.lines[branch])))
                for each in called:
                    run(each, times * (int(trips[1]) if trips else 1))

        run(self._entry, 1)
        return dict(runs)


def bytes_of(shapes: str) -> int:
    """Bytes of the arrays whose types and shapes a program's text has, such as `(bf16[2,3]{1,0}, pred[])`."""
    size = 0
    for kind, bits, shape in _ARRAY.findall(shapes):
        items = math.prod(int(side) for side in shape.split(",") if side)
        size += items * (1 if kind == "pred" else max(1, int(bits) // 8))
    return size
