"""Kernels of a compiled program and the bytes that they read and write, counted from its text."""

from __future__ import annotations

import re
from typing import NamedTuple

from logvggt_jax.doctor.inference import ATTENTION_CALLS
from logvggt_jax.program_text import ProgramText, bytes_of

_INSTRUCTION = re.compile(r"^\s+(?:ROOT )?%?([\w.\-]+) = (\([^=]*?\)|\S+) ([\w\-]+)\((.*)$")
# What takes no kernel of its own.
_FREE = {"parameter", "constant", "get-tuple-element", "tuple", "bitcast", "after-all", "while", "call", "conditional"}
_FUSED = re.compile(r" fusion\(.*\bcalls=%?([\w.\-]+)")
# Of an instruction, all that says nothing of what is computed.
_REMARKS = re.compile(r", (?:metadata|backend_config|frontend_attributes)=\{.*")
_PRODUCT = ("__cublas", " dot(")


class Kernels(NamedTuple):
    """How many there are, and bytes of operands and results. A part of an operand counts as the whole."""

    count: int
    size: int


def kernels(program: str) -> dict[str, Kernels]:
    """Kernels of one run by what they are: `attention`, `products`, `convolutions` or `others`; see `ProgramText.runs`.

    Raises:
      ValueError: a line of the program is not understood.
    """
    found: dict[str, Kernels] = dict.fromkeys(("attention", "products", "convolutions", "others"), Kernels(0, 0))
    text = ProgramText(program)
    for computation, times in text.runs(fused=False).items():
        sizes: dict[str, int] = {}
        for line in text.lines[computation]:
            match = _INSTRUCTION.match(line)
            if match is None:
                raise ValueError(f"not an instruction: {line.strip():.100}")
            result, shapes, operation, rest = match.groups()
            sizes[result] = bytes_of(shapes)
            if operation in _FREE:
                continue
            operands = set(re.findall(r"%?([\w.\-]+)", rest.split(")")[0])) & sizes.keys()
            fused = re.search(r"calls=%?([\w.\-]+)", line)
            target = re.search(r'custom_call_target="([^"]+)"', line)
            kind = _kind((target[1] if target else f" {operation}(") + "".join(text.lines[fused[1]] if fused else ()))
            count, size = found[kind]
            moved = sizes[result] + sum(sizes[operand] for operand in operands)
            found[kind] = Kernels(count + times, size + times * moved)
    return found


def different_fusions(program: str) -> int:
    """Fusions of a program without those that are another's equal: for GPUs XLA compiles each of these once."""
    text = ProgramText(program)
    fused = {name for lines in text.lines.values() for line in lines for name in _FUSED.findall(line)}
    return len({_numbered("\n".join(_REMARKS.sub("", line) for line in text.lines[name])) for name in fused})


def _numbered(body: str) -> str:
    """A computation whose values are called by their order."""
    numbers: dict[str, str] = {}
    return re.sub(r"%[\w.\-]+", lambda match: numbers.setdefault(match[0], f"%{len(numbers)}"), body)


def _kind(text: str) -> str:
    if any(name in text for name in ATTENTION_CALLS.values()):
        return "attention"
    if any(name in text for name in _PRODUCT):
        return "products"
    # On TPUs products are convolutions as well.
    return "convolutions" if "__cudnn$conv" in text or " convolution(" in text else "others"
