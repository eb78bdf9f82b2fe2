"""Results as tables of text, one set for every benchmark; the paper's own are in `paper_tables`."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from logvggt_jax.evaluation.scores import SFM

MARK = "†"


class Table(NamedTuple):
    """A table of text: first column left, the others right; the best value of a column may be set in ** **."""

    title: str
    header: list[str]
    rows: list[list[str]]
    notes: tuple[str, ...] = ()


class Column(NamedTuple):
    """Heading, key in a summary entry, decimals, whether more is better, group of metrics."""

    heading: str
    key: str
    decimals: int
    more_is_better: bool
    group: str


class Section(NamedTuple):
    """One table: title and columns."""

    title: str
    columns: tuple[Column, ...]


_POSE = (
    Column("ATE (m)", "ate", 4, False, "trajectory"),
    Column("ATE / radius", "ate_ratio", 3, False, "trajectory"),
    Column("RRA@5", "rra@5", 3, True, "pose"),
    Column("RRA@30", "rra@30", 3, True, "pose"),
    Column("RTA@30", "rta@30", 3, True, "pose"),
    Column("AUC@30", "auc@30", 3, True, "pose"),
    Column("rotation (°)", "rotation_error", 2, False, "pose"),
)
SECTIONS = (
    Section(
        "Depth",
        (
            Column("Abs Rel (scale)", "scale/abs_rel", 4, False, "depth"),
            Column("δ<1.25 (scale)", "scale/delta_1.25", 4, True, "depth"),
            Column("Abs Rel (median)", "median/abs_rel", 4, False, "depth"),
            Column("δ<1.25 (median)", "median/delta_1.25", 4, True, "depth"),
        ),
    ),
    Section("Pose", (*_POSE, Column("rotation / identity", "rotation_ratio", 3, False, "pose"))),
    Section(
        "Pose against structure from motion",
        tuple(column._replace(key=SFM + column.key, group=SFM + column.group) for column in _POSE),
    ),
    Section(
        "Points (m)",
        (
            Column("Acc mean", "acc_mean", 4, False, "points"),
            Column("Acc median", "acc_median", 4, False, "points"),
            Column("Comp mean", "comp_mean", 4, False, "points"),
            Column("Comp median", "comp_median", 4, False, "points"),
            Column("NC mean", "nc_mean", 3, True, "points"),
            Column("NC median", "nc_median", 3, True, "points"),
            Column("CD sum", "chamfer_sum", 4, False, "points"),
            Column("CD mean", "chamfer_mean", 4, False, "points"),
        ),
    ),
)


def benchmark_tables(results: Mapping[str, Any]) -> list[Table]:
    """Tables of every benchmark that was measured; the best value of a column is set in ** **.

    The last column says how many of the planned clips are in each mean, for each group of metrics.
    """
    static = {method["name"] for method in results["methods"] if method["static"]}
    made: list[Table] = []
    for benchmark in results["benchmarks"]:
        entries = [entry for entry in results["summary"] if entry["benchmark"] == benchmark["name"]]
        for section in SECTIONS:
            groups = sorted({column.group for column in section.columns})
            asked = [group for group in groups if any(_asked(entry, group) for entry in entries)]
            if not any(_count(entry, group) for entry in entries for group in asked):
                continue
            columns = [column for column in section.columns if column.group in asked]
            shown = [entry for entry in entries if any(_count(entry, group) for group in asked)]
            headings = [f"{column.heading} {'↑' if column.more_is_better else '↓'}" for column in columns]
            bests = [_best(shown, column) for column in columns]
            rows = [
                [
                    entry["method"],
                    *(
                        _cell(entry, column, best) + (MARK if column.key == "ate" and entry["method"] in static else "")
                        for column, best in zip(columns, bests, strict=True)
                    ),
                    _counts(entry, [group for group in asked if _asked(entry, group)]),
                ]
                for entry in shown
            ]
            made.append(Table(f"{section.title}, {benchmark['title']}", ["method", *headings, "clips"], rows))
    return made


def coverage_table(results: Mapping[str, Any]) -> Table:
    """Which benchmarks were evaluated, on what, and which are missing."""
    header = ["benchmark", "split", "sequences", "clips", "frames asked", "frames used", "state"]
    rows = []
    for benchmark in results["benchmarks"]:
        used = benchmark["frames_used"]
        measured = max(
            (e["clips_measured"] for e in results["summary"] if e["benchmark"] == benchmark["name"]), default=0
        )
        rows.append(
            [
                benchmark["name"],
                benchmark["split"] or "-",
                f"{benchmark['sequences']}" + (f"/{benchmark['expected']}" if benchmark["expected"] else ""),
                f"{measured}/{benchmark['planned']}",
                "all" if benchmark["wanted"] is None else str(benchmark["wanted"]),
                "-" if used is None else (str(used[0]) if used[0] == used[1] else f"{used[0]} to {used[1]}"),
                _state(benchmark, measured),
            ]
        )
    return Table("Benchmarks", header, rows)


def _state(benchmark: Mapping[str, Any], measured: int) -> str:
    if benchmark["missing"]:
        return "missing"
    if measured < benchmark["planned"] or benchmark["sequences"] < (benchmark["expected"] or 0):
        return "incomplete"
    short = benchmark["wanted"] is not None and (benchmark["frames_used"] or [0])[0] < benchmark["wanted"]
    return "complete, some sequences shorter" if short else "complete"


def _asked(entry: Mapping[str, Any], group: str) -> bool:
    return f"clips_{group}" in entry


def _count(entry: Mapping[str, Any], group: str) -> int:
    return int(entry.get(f"clips_{group}", 0))


def _best(entries: Sequence[Mapping[str, Any]], column: Column) -> float | None:
    values = [entry[column.key] for entry in entries if entry.get(column.key) is not None]
    if len(values) < 2:
        return None
    return max(values) if column.more_is_better else min(values)


def _cell(entry: Mapping[str, Any], column: Column, best: float | None) -> str:
    value = entry.get(column.key)
    if value is None:
        return "-"
    text = f"{value:.{column.decimals}f}"
    if column.key in entry.get("spread", ()):
        text += f" ± {entry['spread'][column.key]:.{column.decimals}f}"
    return f"**{text}**" if value == best else text


def _counts(entry: Mapping[str, Any], groups: Sequence[str]) -> str:
    counts = [_count(entry, group) for group in groups]
    if len(set(counts)) == 1:
        return f"{counts[0]}/{entry['clips']}"
    return ", ".join(f"{group} {count}/{entry['clips']}" for group, count in zip(groups, counts, strict=True))
