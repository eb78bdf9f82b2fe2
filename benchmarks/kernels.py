"""Kernels of a compiled program and the bytes that they read and write, counted from its text."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from typing import NamedTuple

_COMPUTATION = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\) -> .* \{$")
_INSTRUCTION = re.compile(r"^\s+(?:ROOT )?%?([\w.\-]+) = (\([^=]*?\)|\S+) ([\w\-]+)\((.*)$")
_ARRAY = re.compile(r"\b(pred|[a-z]+(\d+)\w*)\[([\d,]*)\]")
# What takes no kernel of its own.
_FREE = {"parameter", "constant", "get-tuple-element", "tuple", "bitcast", "after-all"}
_ATTENTION, _PRODUCT = ("__cudnn$fmha", "tpu_custom_call"), ("__cublas", " dot(")


class Kernels(NamedTuple):
    """How many there are, and bytes of operands and results. A part of an operand counts as the whole."""

    count: int
    size: int


def kernels(program: str) -> dict[str, Kernels]:
    """Kernels of one run by what they are: `attention`, `products`, `convolutions` or `others`.

    Loops count as often as they run where the program says how often that is.
    """
    bodies: dict[str, list[str]] = defaultdict(list)
    entry = name = ""
    for line in program.splitlines():
        if match := _COMPUTATION.match(line):
            name = match[2]
            entry = name if match[1] else entry
        elif line.startswith("  "):
            bodies[name].append(line)
    found: dict[str, Kernels] = dict.fromkeys(("attention", "products", "convolutions", "others"), Kernels(0, 0))

    def walk(computation: str, times: int) -> None:
        sizes: dict[str, int] = {}
        for line in bodies[computation]:
            match = _INSTRUCTION.match(line)
            if match is None:
                continue
            result, shapes, operation, rest = match.groups()
            sizes[result] = _size(shapes)
            if operation in _FREE:
                continue
            if operation in ("while", "call"):
                trips = re.search(r'"known_trip_count":\{"n":"(\d+)"', line)
                (called,) = re.findall(r"(?:body|to_apply)=%?([\w.\-]+)", line)
                walk(called, times * (int(trips[1]) if trips else 1))
                continue
            operands = set(re.findall(r"%?([\w.\-]+)", rest.split(")")[0])) & sizes.keys()
            called = re.search(r"calls=%?([\w.\-]+)", line)
            target = re.search(r'custom_call_target="([^"]+)"', line)
            kind = _kind((target[1] if target else f" {operation}(") + "".join(bodies[called[1]] if called else ()))
            count, size = found[kind]
            moved = sizes[result] + sum(sizes[operand] for operand in operands)
            found[kind] = Kernels(count + times, size + times * moved)

    walk(entry, 1)
    return found


def _size(shapes: str) -> int:
    total = 0
    for kind, bits, sides in _ARRAY.findall(shapes):
        items = math.prod(int(side) for side in sides.split(",") if side)
        total += items * (1 if kind == "pred" else max(1, int(bits) // 8))
    return total


def _kind(text: str) -> str:
    if any(name in text for name in _ATTENTION):
        return "attention"
    if any(name in text for name in _PRODUCT):
        return "products"
    # On TPUs products are convolutions as well.
    return "convolutions" if "__cudnn$conv" in text or " convolution(" in text else "others"
