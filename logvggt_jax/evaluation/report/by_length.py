"""Methods as sequences grow: accuracy beside cost, as tables and one picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from logvggt_jax.evaluation.costs.streams import median_rate
from logvggt_jax.evaluation.report.tables import MARK, Table

LENGTH_FIGURE = "figures/by_length.png"

STATE_NOTE = (
    "What a method keeps between two frames for those to come, at most, without parameters. VGGT offline and FastVGGT "
    "keep the pictures; the activations of all frames, which they need at once when the sequence ends, are not in it. "
    "Chunks likewise."
)


class Quantity(NamedTuple):
    """A table, and a panel of the picture.

    Attributes:
      title: with the unit.
      decimals: in the table.
      more_is_better: which value of a column is the best.
      of: results to values by method and number of frames.
      logarithmic: whether the picture's axis is.
    """

    title: str
    decimals: int
    more_is_better: bool
    of: Callable[[Mapping[str, Any]], dict[str, dict[int, float]]]
    logarithmic: bool = False


def length_tables(results: Mapping[str, Any]) -> list[Table]:
    """One table a quantity, a column a length; none where the run timed nothing.

    The best value of a column is set in ** **; of ATE that of a camera that moves.
    """
    if not has_costs(results):
        return []
    static = {method["name"] for method in results["methods"] if method["static"]}
    made = []
    for quantity in _QUANTITIES:
        values = quantity.of(results)
        lengths = sorted({length for by_length in values.values() for length in by_length})
        header = ["method", *(f"{length} {'↑' if quantity.more_is_better else '↓'}" for length in lengths)]
        best = max if quantity.more_is_better else min
        bests = {
            length: best(by[length] for name, by in values.items() if length in by and name not in static)
            for length in lengths
            if any(length in by for name, by in values.items() if name not in static)
        }
        rows = []
        for name, by_length in values.items():
            mark = MARK if quantity.title.startswith("ATE") and name in static else ""
            cells = [_cell(by_length.get(length), quantity.decimals, bests.get(length)) + mark for length in lengths]
            rows.append([name, *cells])
        made.append(Table(f"{quantity.title} by frames of the sequence", header, rows, _notes(quantity, results)))
    return [table for table in made if table.rows]


def length_panels(results: Mapping[str, Any]) -> dict[str, dict[str, list[tuple[int, float]]]]:
    """By quantity and method, (frames, value) in rising order, for `figures.length_plot`."""
    found = {quantity.title: quantity.of(results) for quantity in _QUANTITIES}
    return {
        title: {name: sorted(by_length.items()) for name, by_length in values.items()}
        for title, values in found.items()
        if values
    }


def logarithmic_panels() -> frozenset[str]:
    """Titles of the panels whose values span orders of magnitude."""
    return frozenset(quantity.title for quantity in _QUANTITIES if quantity.logarithmic)


def has_costs(results: Mapping[str, Any]) -> bool:
    """Whether the run timed its methods over lengths."""
    return "costs" in results.get("timings", {})


def _measured(key: str) -> Callable[[Mapping[str, Any]], dict[str, dict[int, float]]]:
    """A metric of clips."""

    def of(results: Mapping[str, Any]) -> dict[str, dict[int, float]]:
        found: dict[str, dict[int, float]] = {}
        for entry in results["summary"]:
            if entry.get(key) is not None:
                found.setdefault(entry["method"], {})[entry["frames"]] = entry[key]
        return found

    return of


def _cost(
    value: Callable[[Mapping[str, Any]], float | None],
) -> Callable[[Mapping[str, Any]], dict[str, dict[int, float]]]:
    """What a sequence costs."""

    def of(results: Mapping[str, Any]) -> dict[str, dict[int, float]]:
        found: dict[str, dict[int, float]] = {}
        for name, costs in results["timings"]["costs"].items():
            numbers = {int(length): value(cost) for length, cost in costs.items()}
            found[name] = {length: number for length, number in numbers.items() if number is not None}
        return found

    return of


def _megabytes(cost: Mapping[str, Any]) -> float | None:
    return cost["state_bytes"] / 1e6 if "state_bytes" in cost else None


_QUANTITIES = (
    Quantity("ATE (m)", 4, False, _measured("ate")),
    Quantity("Abs Rel (scale)", 4, False, _measured("scale/abs_rel")),
    Quantity("Frames a second", 1, True, _cost(median_rate)),
    Quantity("State (MB)", 3, False, _cost(_megabytes), logarithmic=True),
)


def _cell(value: float | None, decimals: int, best: float | None) -> str:
    if value is None:
        return "-"
    text = f"{value:,.{decimals}f}"
    return f"**{text}**" if value == best else text


def _notes(quantity: Quantity, results: Mapping[str, Any]) -> tuple[str, ...]:
    timings = results["timings"]
    if quantity.title.startswith("State"):
        return (STATE_NOTE,)
    if not quantity.title.startswith("Frames"):
        return ()
    height, width = timings["image_size"]
    made = sum(cost.get("compilations", 0) for costs in timings["costs"].values() for cost in costs.values())
    reasons = [
        f"No rate of {name}, {length} frames: {cost['reason']}."
        for name, costs in timings["costs"].items()
        for length, cost in costs.items()
        if "reason" in cost
    ]
    return (
        f"{timings['device']}, {timings['dtype']}, {width} x {height} pixels, batch 1; pictures from and depth to host "
        f"memory within the time; median of {timings['rounds']} runs after one that compiles. Programs compiled in the "
        f"timed runs: {made}.",
        *reasons,
    )
