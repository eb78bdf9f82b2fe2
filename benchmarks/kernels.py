"""Kernels of a compiled program and the bytes that they read and write, counted from its text."""

from __future__ import annotations

import re
from collections import defaultdict
from typing import NamedTuple

from logvggt_jax.doctor.inference import ATTENTION_CALLS
from logvggt_jax.training.step.costs import bytes_of

_COMPUTATION = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\) -> .* \{$")
_INSTRUCTION = re.compile(r"^\s+(?:ROOT )?%?([\w.\-]+) = (\([^=]*?\)|\S+) ([\w\-]+)\((.*)$")
_CALLED = re.compile(r"\b(?:body|to_apply|true_computation|false_computation)=(\S+?),|branch_computations=\{(.*?)\}")
# What takes no kernel of its own.
_FREE = {"parameter", "constant", "get-tuple-element", "tuple", "bitcast", "after-all"}
_PRODUCT = ("__cublas", " dot(")


class Kernels(NamedTuple):
    """How many there are, and bytes of operands and results. A part of an operand counts as the whole."""

    count: int
    size: int


def kernels(program: str) -> dict[str, Kernels]:
    """Kernels of one run by what they are: `attention`, `products`, `convolutions` or `others`.

    Loops count as often as they run where the program says how often that is; of the branches of a condition the one
    that moves the most bytes.

    Raises:
      ValueError: a line of the program is not understood.
    """
    bodies: dict[str, list[str]] = defaultdict(list)
    entry = name = ""
    # Wide tuples are numbered in comments.
    for line in re.sub(r"/\*.*?\*/", "", program).splitlines():
        if match := _COMPUTATION.match(line):
            name = match[2]
            entry = name if match[1] else entry
        elif name and line.startswith("  ") and " = " in line:
            bodies[name].append(line)

    def walk(computation: str) -> dict[str, Kernels]:
        found: dict[str, Kernels] = dict.fromkeys(("attention", "products", "convolutions", "others"), Kernels(0, 0))

        def add(kind: str, count: int, size: int) -> None:
            found[kind] = Kernels(found[kind].count + count, found[kind].size + size)

        sizes: dict[str, int] = {}
        for line in bodies[computation]:
            match = _INSTRUCTION.match(line)
            if match is None:
                raise ValueError(f"not an instruction: {line.strip():.100}")
            result, shapes, operation, rest = match.groups()
            sizes[result] = bytes_of(shapes)
            if operation in _FREE:
                continue
            if operation in ("while", "call", "conditional"):
                trips = re.search(r'"known_trip_count":\{"n":"(\d+)"', line)
                times = int(trips[1]) if trips else 1
                called = re.findall(r"%?([\w.\-]+)", " ".join("".join(names) for names in _CALLED.findall(line)))
                branches = [walk(name) for name in called]
                for kind, each in max(branches, key=lambda branch: sum(each.size for each in branch.values())).items():
                    add(kind, times * each.count, times * each.size)
                continue
            operands = set(re.findall(r"%?([\w.\-]+)", rest.split(")")[0])) & sizes.keys()
            fused = re.search(r"calls=%?([\w.\-]+)", line)
            target = re.search(r'custom_call_target="([^"]+)"', line)
            kind = _kind((target[1] if target else f" {operation}(") + "".join(bodies[fused[1]] if fused else ()))
            add(kind, 1, sizes[result] + sum(sizes[operand] for operand in operands))
        return found

    return walk(entry)


def _kind(text: str) -> str:
    if any(name in text for name in ATTENTION_CALLS.values()):
        return "attention"
    if any(name in text for name in _PRODUCT):
        return "products"
    # On TPUs products are convolutions as well.
    return "convolutions" if "__cudnn$conv" in text or " convolution(" in text else "others"
