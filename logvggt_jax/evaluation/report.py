"""Results as tables: on the terminal and as a Markdown page."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from logvggt_jax.evaluation.runner import write_text

_FILE_WIDTH = 128
_MARK = "†"


class Column(NamedTuple):
    """Heading, key in a summary entry, decimals, and whether more is better."""

    heading: str
    key: str
    decimals: int
    more_is_better: bool


class Section(NamedTuple):
    """One table: title, the group of metrics whose clips are counted, columns."""

    title: str
    groups: tuple[str, ...]
    columns: tuple[Column, ...]


SECTIONS = (
    Section(
        "Depth",
        ("depth",),
        (
            Column("Abs Rel (scale)", "scale/abs_rel", 4, False),
            Column("δ<1.25 (scale)", "scale/delta_1.25", 4, True),
            Column("Abs Rel (median)", "median/abs_rel", 4, False),
            Column("δ<1.25 (median)", "median/delta_1.25", 4, True),
        ),
    ),
    Section(
        "Pose",
        ("pose", "trajectory"),
        (
            Column("ATE (m)", "ate", 4, False),
            Column("ATE / radius", "ate_ratio", 3, False),
            Column("RRA@5", "rra@5", 3, True),
            Column("RRA@30", "rra@30", 3, True),
            Column("RTA@30", "rta@30", 3, True),
            Column("AUC@30", "auc@30", 3, True),
            Column("rotation (°)", "rotation_error", 2, False),
            Column("rotation / identity", "rotation_ratio", 3, False),
        ),
    ),
    Section(
        "Points (m)",
        ("points",),
        (
            Column("Acc mean", "acc_mean", 4, False),
            Column("Acc median", "acc_median", 4, False),
            Column("Comp mean", "comp_mean", 4, False),
            Column("Comp median", "comp_median", 4, False),
            Column("NC mean", "nc_mean", 3, True),
            Column("NC median", "nc_median", 3, True),
        ),
    ),
)

DEFINITIONS = (
    "Abs Rel: mean of |d - d*| / d* over the valid pixels of a clip; δ<1.25: fraction of them with "
    "max(d/d*, d*/d) < 1.25. One scale a clip, by ten reweighted least-absolute steps (scale) or the ratio of lower "
    "medians (median). Mean over clips weighted by valid pixels.",
    "ATE: root mean square distance of camera positions after the best similarity; ATE / radius: the same over the "
    "root mean square distance of the true positions from their mean (1 = standing still; random motion stays below "
    "1 on short clips, since the similarity fits seven numbers to it). A camera that stands still has no similarity: "
    f"what is printed as its ATE is that root mean square distance, marked {_MARK}.",
    "RRA@τ, RTA@τ: fraction of frame pairs whose relative rotation, or direction of translation (sign ignored), is "
    "wrong by less than τ degrees; AUC@30: mean over 1, 2, … 30 degrees of the fraction of pairs in which both are. "
    "It is at most min(RRA@30, RTA@30).",
    "rotation: mean error over pairs in degrees; rotation / identity: over the error of predicting no rotation "
    "(1 = no information, above 1 = worse than none).",
    "Acc, Comp: distance of predicted points to the nearest true point and back; NC: |cosine| of nearest neighbours' "
    "normals, 30 neighbours each (0.5 = random). Points are pixels with a true depth, unprojected with predicted "
    "depth, intrinsics and pose, aligned by one similarity over corresponding pixels (7 degrees of freedom), then "
    "by rigid ICP; no crop, no confidence threshold. Read Acc and Comp "
    "together: a cloud that collapses has a small Acc. Mean over clips, also of the medians.",
)


def print_report(results: Mapping[str, Any], console: Console | None = None) -> None:
    """Prints the tables, what each row knows, what was left out, and the command that gives the numbers again."""
    console = console or Console()
    if not console.is_terminal:
        console.width = max(console.width, _FILE_WIDTH)
    for title, header, rows in tables(results):
        table = Table(title=title, title_justify="left")
        for position, heading in enumerate(header):
            table.add_column(heading, justify="left" if position == 0 else "right", no_wrap=position == 0)
        for row in rows:
            table.add_row(*(re.sub(r"\*\*(.+?)\*\*", r"[bold]\1[/bold]", cell) for cell in row))
        console.print(table)
    for line in _notes(results):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def write_report(results: Mapping[str, Any], path: Path) -> None:
    """Writes the same as a Markdown page."""
    lines = [f"# {results['title']}", ""]
    for title, header, rows in tables(results):
        lines += [f"## {title}", "", _markdown_row(header)]
        lines += [_markdown_row(["---", *["---:"] * (len(header) - 1)])]
        lines += [_markdown_row(row) for row in rows] + [""]
    lines += ["## Notes", ""] + [f"- {line}" for line in _notes(results)]
    write_text(path, "\n".join(lines) + "\n")


def tables(results: Mapping[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, header and rows of every table; the best value of a column is set in ** **.

    The last column says how many of the clips are in each mean, for each group of metrics.
    """
    static = {method["name"] for method in results["methods"] if method["static"]}
    made = []
    for frames in dict.fromkeys(entry["frames"] for entry in results["summary"]):
        entries = [entry for entry in results["summary"] if entry["frames"] == frames]
        for section in SECTIONS:
            shown = [entry for entry in entries if any(entry.get(f"clips_{group}") for group in section.groups)]
            if not shown:
                continue
            header = ["method", *(_arrow(column) for column in section.columns), "clips"]
            bests = [_best(shown, column) for column in section.columns]
            rows = [
                [
                    entry["method"],
                    *(
                        _cell(entry, column, best)
                        + (_MARK if column.key == "ate" and entry["method"] in static else "")
                        for column, best in zip(section.columns, bests, strict=True)
                    ),
                    _counts(entry, section),
                ]
                for entry in shown
            ]
            made.append((f"{section.title}, clips of {frames} frames", header, rows))
    return made


def _notes(results: Mapping[str, Any]) -> list[str]:
    config = results["config"]
    height, width = config["image_size"]
    points = config["max_points"] or "all"
    icp = "no ICP" if config["icp_threshold"] is None else f"ICP within {config['icp_threshold']} m"
    lines = [
        f"{width} x {height} pixels, stride {config['stride']}, {config['clips_per_sequence']} clip(s) a sequence; "
        f"{points} points a clip at most (seed {config['seed']}, the same pixels for prediction and truth); {icp}."
    ]
    lines += [f"{method['name']} knows: {method['knows']}." for method in results["methods"]]
    lines += DEFINITIONS
    lines += _counted("skipped", [f"{e['frames']} frames" for e in results["skipped"]], results["skipped"])
    kinds = [f"{e['metric']} of {e['method']}, {e['frames']} frames" for e in results["failures"]]
    lines += _counted("not measurable", kinds, results["failures"])
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    lines.append(f"Computed on {results['device']} with {versions}.")
    lines.append(f"To get these numbers again: {results['command']}")
    return lines


def _counted(what: str, kinds: list[str], entries: list[dict[str, Any]]) -> list[str]:
    first: dict[str, dict[str, Any]] = {}
    for kind, entry in zip(kinds, entries, strict=True):
        first.setdefault(kind, entry)
    return [
        f"{what}: {kind}, {count} clip(s) left out of the mean, for example {first[kind]['sequence']}: "
        f"{first[kind]['reason']}"
        for kind, count in Counter(kinds).items()
    ]


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _arrow(column: Column) -> str:
    return f"{column.heading} {'↑' if column.more_is_better else '↓'}"


def _best(entries: list[dict[str, Any]], column: Column) -> float | None:
    values = [entry[column.key] for entry in entries if entry.get(column.key) is not None]
    if len(values) < 2:
        return None
    return max(values) if column.more_is_better else min(values)


def _cell(entry: dict[str, Any], column: Column, best: float | None) -> str:
    value = entry.get(column.key)
    if value is None:
        return "-"
    text = f"{value:.{column.decimals}f}"
    return f"**{text}**" if value == best else text


def _counts(entry: dict[str, Any], section: Section) -> str:
    counts = [entry.get(f"clips_{group}", 0) for group in section.groups]
    if len(set(counts)) == 1:
        return f"{counts[0]}/{entry['clips']}"
    return ", ".join(f"{group} {count}/{entry['clips']}" for group, count in zip(section.groups, counts, strict=True))
