"""What stands below the pictures and above the tables of a report, in words."""

import re
from collections.abc import Mapping
from typing import Any

from logvggt_jax.errors import printable
from logvggt_jax.evaluation.report.tables import SECTIONS

_SHOWN = {
    "depth": "images, true and predicted depth (yellow near, violet far, scaled to the truth by medians) and relative "
    "error",
    "trajectory": "true and predicted camera positions, aligned by a similarity, in the plane in which they move most",
    "points": "predicted points, aligned, and true points, seen from behind and above the first camera",
}


def caption(stem: str) -> str:
    """Words for a picture of the name `stem` (without suffix), as the runner and the report name theirs."""
    if found := re.fullmatch(rf"(.+)_from_(\d+)_(\d+)_frames_[0-9a-f]{{8}}_({'|'.join(_SHOWN)})", stem):
        clip, first, frames, kind = found.groups()
        return f"{clip}, {frames} frames from frame {first} on: {_SHOWN[kind]}."
    return f"{stem[:1].upper()}{stem[1:].replace('_', ' ')}."


def summary(results: Mapping[str, Any]) -> list[str]:
    """What was evaluated, and how the first row does against the others, a `printable` sentence each."""
    names, benchmarks = [method["name"] for method in results["methods"]], results["benchmarks"]
    there = [benchmark for benchmark in benchmarks if not benchmark["missing"]]
    lines = [
        f"Rows: {len(names)}. Benchmarks: {len(there)}"
        + (f" of {len(benchmarks)}; the others' data are missing." if len(there) < len(benchmarks) else ".")
    ]
    for benchmark in there:
        entries = [entry for entry in results["summary"] if entry["benchmark"] == benchmark["name"]]
        for column in (section.columns[0] for section in SECTIONS):
            values = {entry["method"]: entry[column.key] for entry in entries if entry.get(column.key) is not None}
            if names[0] not in values or len(values) < 2:
                continue
            own = values[names[0]]
            better = sum(value > own if column.more_is_better else value < own for value in values.values())
            best = (max if column.more_is_better else min)(values, key=lambda name: values[name])
            rest = "" if best == names[0] else f"; the best is {best} with {values[best]:.{column.decimals}f}"
            lines.append(
                f"{benchmark['title']}: {names[0]} is number {better + 1} of {len(values)} rows by {column.heading}, "
                f"{own:.{column.decimals}f}{rest}."
            )
    return [printable(line) for line in lines]
