"""An evaluation's results for readers: on the terminal, as Markdown, CSV and one HTML page."""

import csv
import io
import os
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from logvggt_jax.errors import disk_errors, printable
from logvggt_jax.evaluation.report.by_length import (
    LENGTH_FIGURE,
    has_costs,
    length_panels,
    length_tables,
    logarithmic_panels,
)
from logvggt_jax.evaluation.report.captions import caption, summary
from logvggt_jax.evaluation.report.page import html_page
from logvggt_jax.evaluation.report.paper_tables import paper_tables
from logvggt_jax.evaluation.report.tables import MARK, Table, benchmark_tables, coverage_table
from logvggt_jax.files import write_text

# Of output that goes to a file: the widest of the paper's tables is not cut.
_FILE_WIDTH = 240
AGAIN = "To get these numbers again:"

DEFINITIONS = {
    "depth": "Abs Rel: mean of |d - d*| / d* over the valid pixels of a clip; δ<1.25: fraction of them with "
    "max(d/d*, d*/d) < 1.25. One scale a clip, by ten reweighted least-absolute steps (scale) or the ratio of lower "
    "medians (median). Mean over clips weighted by valid pixels.",
    "trajectory": "ATE: root mean square distance of camera positions after the best similarity; ATE / radius: the "
    "same over the root mean square distance of the true positions from their mean (1 = standing still; random motion "
    "stays below 1 on short clips, since the similarity fits seven numbers to it). A camera that stands still has no "
    f"similarity: what is printed as its ATE is that root mean square distance, marked {MARK}.",
    "pose": "RRA@τ, RTA@τ: fraction of frame pairs whose relative rotation, or direction of translation (sign "
    "ignored), is wrong by less than τ degrees; AUC@30: mean over 1, 2, … 30 degrees of the fraction of pairs in which "
    "both are. It is at most min(RRA@30, RTA@30). rotation: mean error over pairs in degrees; rotation / identity: "
    "over the error of predicting no rotation (1 = no information, above 1 = worse than none).",
    "points": "Acc, Comp: distance of predicted points to the nearest true point and back; CD: their sum and half of "
    "it; NC: |cosine| of nearest neighbours' normals, 30 neighbours each (0.5 = random). Points are pixels with a true "
    "depth, unprojected with predicted depth, intrinsics and pose, aligned by one similarity over corresponding pixels "
    "(7 degrees of freedom), then by rigid ICP where it is on. Read Acc and Comp together: a cloud that collapses has "
    "a small Acc. Mean over clips, also of the medians.",
}


def print_report(results: Mapping[str, Any], console: Console | None = None) -> None:
    """Prints the tables, what each row knows, what was left out, and the command that gives the numbers again."""
    console = console or Console()
    if not console.is_terminal:
        console.width = max(console.width, _FILE_WIDTH)
    # Titles and names are text and no markup, in which [/x] would be an error.
    for shown in tables(results):
        table = RichTable(title=Text(shown.title), title_justify="left")
        for position, heading in enumerate(shown.header):
            table.add_column(Text(heading), justify="left" if position == 0 else "right", no_wrap=position == 0)
        for row in shown.rows:
            table.add_row(*(Text(cell.replace("**", ""), style="bold" if "**" in cell else "") for cell in row))
        console.print(table)
        for note in shown.notes:
            console.print(Text(note), soft_wrap=True)
    for line in [*notes(results), f"{AGAIN} {printable(results['command'])}"]:
        console.print(Text(line), soft_wrap=True)


def write_report(results: Mapping[str, Any], output: Path) -> None:
    """Writes report.md, report.html (self-contained, with the figures) and every table as tables/<n>-<title>.csv."""
    made = tables(results)
    _draw_curves(results, output)
    write_text(output / "report.md", _markdown(results, made))
    with disk_errors(output / "tables"):
        (output / "tables").mkdir(exist_ok=True)
        for old in (output / "tables").glob("[0-9][0-9]-*.csv"):
            old.unlink()
    for number, table in enumerate(made, start=1):
        write_text(output / "tables" / f"{number:02d}-{_slug(table.title)}.csv", _csv(table))
    pictures = [output / name for name in [*_curve_figures(results), *results["figures"]]]
    lines = [*notes(results), f"{AGAIN} {printable(results['command'])}"]
    captions = {path: caption(path.stem) for path in pictures if path.is_file()}
    own = printable(results["methods"][0]["name"])
    page = html_page(printable(results["title"]), summary(results), made, lines, captions, own)
    write_text(output / "report.html", page)


def tables(results: Mapping[str, Any]) -> list[Table]:
    """All tables, their text `printable`; those of growing sequences come first, or for the paper's benchmarks their
    coverage and the paper's own."""
    made = [*length_tables(results), *benchmark_tables(results)]
    if not all("-clips-" in benchmark["name"] for benchmark in results["benchmarks"]):
        made = [coverage_table(results), *paper_tables(results), *made]
    return [
        Table(
            printable(table.title),
            [printable(cell) for cell in table.header],
            [[printable(cell) for cell in row] for row in table.rows],
            tuple(printable(note) for note in table.notes),
        )
        for table in made
    ]


def notes(results: Mapping[str, Any]) -> list[str]:
    """What a reader has to know to read the tables, a `printable` line each."""
    lines: list[str] = []
    for benchmark in results["benchmarks"]:
        if not benchmark["missing"]:
            frames = f"{benchmark['frames']}; {benchmark['images']}{_points_settings(benchmark)}"
            lines.append(f"{benchmark['title']}: {frames}. {' '.join(benchmark['decisions'])}".rstrip())
    lines += [f"{method['name']} knows: {method['knows']}." for method in results["methods"]]
    measured = {key for entry in results["summary"] for key in entry}
    lines += [text for group, text in DEFINITIONS.items() if f"clips_{group}" in measured]
    missing = Counter(benchmark["missing"] for benchmark in results["benchmarks"] if benchmark["missing"])
    lines += [f"missing: {count} benchmark(s) without data: {reason}" for reason, count in missing.items()]
    lines += _counted("skipped", [_of(e) for e in results["skipped"]], results["skipped"])
    kinds = [f"{e['metric']} of {e['method']}, {_of(e)}" for e in results["failures"]]
    lines += _counted("not measurable", kinds, results["failures"])
    for environment in results["environments"]:
        versions = ", ".join(f"{name} {version}" for name, version in environment["versions"].items())
        lines.append(f"Computed on {environment['device']}, commit {environment['commit']}, with {versions}.")
    if results["checkpoint"]:
        lines.append(f"Checkpoint: {results['checkpoint']} (digest of its parameters' digests).")
    return [printable(line) for line in lines]


def _points_settings(benchmark: Mapping[str, Any]) -> str:
    points = benchmark["settings"]["points"]
    if points is None:
        return ""
    count = "all" if points["max_points"] is None else f"{points['max_points']:,}"
    crop = "" if points["crop"] is None else f"middle {points['crop']} x {points['crop']} pixels, "
    icp = "no ICP" if points["icp_threshold"] is None else f"ICP within {points['icp_threshold']} m"
    return f"; {crop}{count} points a clip at most (seed {points['seed']}); {icp}"


def _of(entry: Mapping[str, Any]) -> str:
    return f"{entry['frames']} frames" if "-clips-" in entry["benchmark"] else entry["benchmark"]


def _counted(what: str, kinds: list[str], entries: list[dict[str, Any]]) -> list[str]:
    first: dict[str, dict[str, Any]] = {}
    for kind, entry in zip(kinds, entries, strict=True):
        first.setdefault(kind, entry)
    return [
        f"{what}: {kind}, {count} clip(s) left out of the mean, for example {first[kind]['sequence']}: "
        f"{first[kind]['reason']}"
        for kind, count in Counter(kinds).items()
    ]


def _markdown(results: Mapping[str, Any], made: list[Table]) -> str:
    lines = [f"# {_markdown_text(printable(results['title']))}", ""]
    for table in made:
        lines += [f"## {_markdown_text(table.title)}", "", _markdown_row(table.header)]
        lines += ["| " + " | ".join(["---", *["---:"] * (len(table.header) - 1)]) + " |"]
        lines += [_markdown_row(row) for row in table.rows] + [""]
        lines += [f"{_markdown_text(note)}\n" for note in table.notes]
    lines += ["## Notes", ""] + [f"- {_markdown_text(line)}" for line in notes(results)]
    # A block of code: to be copied, and so not escaped.
    lines += ["", AGAIN, "", f"    {printable(results['command'])}"]
    figures = [*_curve_figures(results), *results["figures"]]
    if figures:
        lines += ["", "## Figures", ""]
        lines += [f"![{_markdown_text(printable(Path(name).stem))}]({quote(os.fsencode(name))})" for name in figures]
    return "\n".join(lines) + "\n"


def _markdown_row(cells: list[str]) -> str:
    return "| " + " | ".join(map(_markdown_cell, cells)) + " |"


def _markdown_cell(text: str) -> str:
    """A cell with its own marks of the best value, and no others."""
    parts = re.split(r"\*\*(.+?)\*\*", text)
    return "".join(f"**{_markdown_text(part)}**" if at % 2 else _markdown_text(part) for at, part in enumerate(parts))


def _markdown_text(text: str) -> str:
    """Text that reads in Markdown as it stands: names of sequences hold whatever files are called."""
    return re.sub(r"([\\`*\[\]<>|&])", r"\\\1", text)


def _csv(table: Table) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(table.header)
    writer.writerows([[cell.replace("**", "") for cell in row] for row in table.rows])
    return buffer.getvalue()


def _slug(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _ate_curves(results: Mapping[str, Any]) -> dict[str, dict[str, list[tuple[int, float]]]]:
    """By data set and method, (views, ATE) of the benchmarks of the paper's figure."""
    curves: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for entry in results["summary"]:
        dataset, _, kind = entry["benchmark"].partition("-")
        if kind.startswith("ate-") and entry.get("ate") is not None:
            curves.setdefault(dataset, {}).setdefault(entry["method"], []).append((entry["frames"], entry["ate"]))
    return curves


def _curve_figures(results: Mapping[str, Any]) -> list[str]:
    by_length = [LENGTH_FIGURE] if has_costs(results) else []
    return [*by_length, *(f"figures/ate_against_views_{dataset}.png" for dataset in _ate_curves(results))]


def _draw_curves(results: Mapping[str, Any], output: Path) -> None:
    from logvggt_jax.evaluation.report import figures as plots

    if has_costs(results):
        panels, logarithmic = length_panels(results), logarithmic_panels()
        plots.length_plot(output / LENGTH_FIGURE, panels, results["timings"]["device"], logarithmic=logarithmic)
    for dataset, curves in _ate_curves(results).items():
        path = output / f"figures/ate_against_views_{dataset}.png"
        plots.curves_plot(path, curves, f"ATE on {dataset}", x_label="views", y_label="ATE (m)")
