"""The paper's tables: its layout, its rows, and below them the rows of this run."""

import importlib.resources
import json
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from logvggt_jax.evaluation.report.tables import Table

THIS_RUN = "this run: "
_IMPOSSIBLE = "‡"
_POSE_METRICS = (("RRA@30", "rra@30"), ("RTA@30", "rta@30"), ("AUC@30", "auc@30"))
_DEPTH_METRICS = (("Abs Rel ↓", "abs_rel", "scale/abs_rel"), ("δ<1.25 ↑", "delta_1.25", "scale/delta_1.25"))
_CLOUDS = (("7-Scenes", "seven_scenes"), ("NRGBD", "nrgbd"))

IMPOSSIBLE_NOTE = (
    f"{_IMPOSSIBLE} The paper's AUC@30 is above its RRA@30 or RTA@30 here, which no area under per-threshold "
    "accuracies up to 30 degrees can be. Ours is the mean over 1, 2, … 30 degrees of the fraction of pairs whose "
    "larger error is below."
)
INCOMPLETE_NOTE = (
    "[17/18] behind a figure of this run: only so many of the benchmark's sequences are in it; the others are missing, "
    "too short, unreadable or failed, and are listed below. A dash: nothing was measured."
)


class PaperColumn(NamedTuple):
    """A column: heading, where the paper's number is (data set, metrics), and where ours is (benchmark, keys).

    Several metrics share a cell with a slash between. Ours is multiplied by `factor`.
    """

    heading: str
    dataset: str
    metrics: tuple[str, ...]
    benchmark: str
    keys: tuple[str, ...]
    group: str
    decimals: int
    factor: float = 1.0


def paper_results() -> dict[str, Any]:
    """The paper's numbers by table, as printed; None where it says OOM."""
    file = importlib.resources.files("logvggt_jax.evaluation") / "paper_results.json"
    return json.loads(file.read_text("utf-8"))["tables"]


def paper_tables(results: Mapping[str, Any]) -> list[Table]:
    """All numeric tables of the paper in its order, the rows of `results` below each group.

    The first method has a row in every group, others where anything of theirs was measured.
    """
    paper = paper_results()
    tables = [
        _table("3D reconstruction (Table 1)", _by_count(paper["rec_7scenes_nrgbd"]["data"], _clouds), results),
        _table("Video depth (Table 2)", [("", paper["video_depth"]["data"], _video_depth())], results),
        _table("Camera pose (Table 3), percent", [("", paper["camera_pose"]["data"], _poses())], results),
        _table("Ablation (Table 4)", _by_count(paper["ablation"]["data"], _ablation), results),
        _table(
            "GCCR settings on CO3Dv2 (Table 5), percent",
            [("", _one_dataset(paper["gccr_variants_co3dv2"]["data"]), _pose_columns("CO3Dv2", "co3dv2-poses-200"))],
            results,
        ),
        _table(
            "3D reconstruction beside XStreamVGGT (appendix), mean / median",
            _by_count(paper["rec_vs_xstreamvggt"]["data"], _cloud_pairs),
            results,
        ),
        _table(
            "Video depth of longer clips (appendix)",
            _by_count(paper["video_depth_multi_input"]["data"], _longer_depth),
            results,
        ),
    ]
    return [*tables, *_timings(paper, results.get("timings"))]


def _by_count(
    data: Mapping[str, Any], columns: Callable[[str], list[PaperColumn]]
) -> list[tuple[str, Any, list[PaperColumn]]]:
    """A group of rows for each number of frames: that number, the paper's rows {method: {data set: {metric: value}}},
    and the columns that `columns` has for it."""
    return [(count, rows, columns(count)) for count, rows in data.items()]


def _one_dataset(rows: Mapping[str, Any]) -> dict[str, Any]:
    """Rows {method: {metric: value}} of a table of CO3Dv2 alone in the form of the others."""
    return {name: {"CO3Dv2": values} for name, values in rows.items()}


def _clouds(count: str) -> list[PaperColumn]:
    """Accuracy, completeness and normals of the clouds of so many frames, mean and median in columns of their own."""
    measures = (
        ("Acc mean ↓", "acc_mean", "acc_mean"),
        ("Acc med ↓", "acc_med", "acc_median"),
        ("Comp mean ↓", "comp_mean", "comp_mean"),
        ("Comp med ↓", "comp_med", "comp_median"),
        ("NC mean ↑", "nc_mean", "nc_mean"),
        ("NC med ↑", "nc_med", "nc_median"),
    )
    return [
        PaperColumn(heading, label, (theirs,), f"{slug}-reconstruction-{count}", (ours,), "points", 3)
        for label, slug in _CLOUDS
        for heading, theirs, ours in measures
    ]


def _cloud_pairs(count: str) -> list[PaperColumn]:
    """The same with mean and median in one cell."""
    return [
        PaperColumn(
            f"{heading} {arrow}",
            label,
            (f"{name}_mean", f"{name}_med"),
            f"{slug}-reconstruction-{count}",
            (f"{name}_mean", f"{name}_median"),
            "points",
            3,
        )
        for label, slug in _CLOUDS
        for heading, name, arrow in (("Acc", "acc", "↓"), ("Comp", "comp", "↓"), ("NC", "nc", "↑"))
    ]


def _video_depth() -> list[PaperColumn]:
    benchmarks = (
        ("Sintel (50 frames)", "sintel-depth"),
        ("Bonn (110 frames)", "bonn-depth-110"),
        ("KITTI (110 frames)", "kitti-depth-110"),
    )
    return [column for label, name in benchmarks for column in _depth_columns(label, name)]


def _longer_depth(count: str) -> list[PaperColumn]:
    return [*_depth_columns("Bonn", f"bonn-depth-{count}"), *_depth_columns("KITTI", f"kitti-depth-{count}")]


def _depth_columns(label: str, benchmark: str) -> list[PaperColumn]:
    """Abs Rel and δ < 1.25, with one scale a sequence, under the heading `label`."""
    return [
        PaperColumn(heading, label, (theirs,), benchmark, (ours,), "depth", 3)
        for heading, theirs, ours in _DEPTH_METRICS
    ]


def _poses() -> list[PaperColumn]:
    benchmarks = (("ScanNet", "scannet"), ("TUM-D", "tum"), ("CO3Dv2", "co3dv2"))
    return [column for label, slug in benchmarks for column in _pose_columns(label, f"{slug}-poses-500")]


def _pose_columns(label: str, benchmark: str) -> list[PaperColumn]:
    """RRA, RTA and AUC at 30 degrees, in percent."""
    return [
        PaperColumn(f"{theirs} ↑", label, (theirs,), benchmark, (ours,), "pose", 2, 100.0)
        for theirs, ours in _POSE_METRICS
    ]


def _ablation(count: str) -> list[PaperColumn]:
    """Chamfer distance and normals of both sets of clouds, and CO3Dv2's poses, of so many frames."""
    columns: list[PaperColumn] = []
    for label, slug in _CLOUDS:
        benchmark = f"{slug}-reconstruction-{count}"
        # The paper does not say whether its CD is the sum of both directions or half of it: ours are both.
        chamfer = PaperColumn("CD ↓", label, ("CD",), benchmark, ("chamfer_sum", "chamfer_mean"), "points", 3)
        columns += [chamfer, PaperColumn("NC ↑", label, ("NC",), benchmark, ("nc_mean",), "points", 3)]
    return [*columns, *_pose_columns("CO3Dv2", f"co3dv2-poses-{count}")]


def _table(
    title: str, groups: Sequence[tuple[str, Mapping[str, Any], list[PaperColumn]]], results: Mapping[str, Any]
) -> Table:
    """The paper's rows of each group of `_by_count`, and below them this run's; groups without counts have "" there."""
    has_counts = bool(groups[0][0])
    header = ["method", *(["frames"] if has_counts else [])]
    header += [f"{column.dataset} {column.heading}" for column in groups[0][2]]
    rows: list[list[str]] = []
    marked = incomplete = False
    for count, paper_rows, columns in groups:
        label = [count] if has_counts else []
        for method, data in paper_rows.items():
            cells = [_paper_cell(data, column) for column in columns]
            marked |= any(_IMPOSSIBLE in cell for cell in cells)
            rows.append([f"{method} (paper)", *label, *cells])
        for position, method in enumerate(results["methods"]):
            cells = [_own_cell(results, method["name"], column) for column in columns]
            incomplete |= any("[" in cell for cell in cells)
            if position and set(cells) == {"-"}:
                continue  # a baseline that claims nothing of this table
            rows.append([f"{THIS_RUN}{method['name']}", *label, *cells])
    notes = [IMPOSSIBLE_NOTE] * marked + [INCOMPLETE_NOTE] * incomplete
    if title.startswith("Ablation"):
        notes.append("CD of this run: sum of both directions / half of it; the paper defines neither.")
    return Table(title, header, rows, tuple(notes))


def _paper_cell(data: Mapping[str, Any], column: PaperColumn) -> str:
    """Of a method's {data set: {metric: value}}; marked where the number cannot be, see `IMPOSSIBLE_NOTE`."""
    values = data[column.dataset]
    numbers = [values[metric] for metric in column.metrics]
    if None in numbers:
        return "OOM"
    text = " / ".join(f"{number:.{column.decimals}f}" for number in numbers)
    bound = "AUC@30" in column.metrics and values["AUC@30"] > min(values["RRA@30"], values["RTA@30"])
    return text + _IMPOSSIBLE if bound else text


def _own_cell(results: Mapping[str, Any], method: str, column: PaperColumn) -> str:
    """Of this run's summary, with the number of clips where not all were measured; a dash for what was not."""
    benchmark = next((b for b in results["benchmarks"] if b["name"] == column.benchmark), None)
    entry = next((e for e in results["summary"] if e["benchmark"] == column.benchmark and e["method"] == method), None)
    if benchmark is None or entry is None:
        return "-"
    numbers = [entry.get(key) for key in column.keys]
    measured, planned = entry.get(f"clips_{column.group}"), max(benchmark["expected"] or 0, benchmark["planned"])
    if measured is None:
        return "-"
    share = f" [{measured}/{planned}]" if measured < planned else ""
    if None in numbers:
        return f"-{share}"
    return " / ".join(f"{column.factor * number:.{column.decimals}f}" for number in numbers) + share


def _timings(paper: Mapping[str, Any], measured: Mapping[str, Any] | None) -> Iterator[Table]:
    """The appendix's tables of runtime and of frames a second; `measured` is what a run that timed itself has."""
    runtime = paper["runtime_breakdown_1000_frames"]["data"]
    rows = [
        [f"{name} (paper)", f"{v['runtime_ms']:,.0f}", f"{v['share_percent']:.2f} %"] for name, v in runtime.items()
    ]
    fps = paper["fps"]["data"]
    lengths = list(next(iter(fps.values())))
    speeds = [[f"{name} (paper)", *(f"{values[length]:.1f}" for length in lengths)] for name, values in fps.items()]
    notes: tuple[str, ...] = ("The paper does not name the hardware behind its times.",)
    if measured is None:
        notes += ("This run timed nothing: its configuration has no field timings.",)
    else:
        notes += (_timing_setting(measured),)
        total = sum(part["seconds"] for part in measured["parts"])
        frames = measured["part_frames"]
        for part in [*measured["parts"], {"name": "total", "seconds": total}]:
            name = f"{THIS_RUN}{part['name']}" + ("" if frames == 1000 else f", {frames} frames")
            rows.append([name, f"{1e3 * part['seconds']:,.0f}", f"{part['seconds'] / total:.2%}".replace("%", " %")])
        lengths += [length for length in map(str, measured["lengths"]) if length not in lengths]
        speeds = [row + ["-"] * (len(lengths) + 1 - len(row)) for row in speeds]
        reasons: dict[str, str] = {}
        for name, rates in measured["frames_per_second"].items():
            speeds.append([f"{THIS_RUN}{name}", *(_rate(rates.get(length)) for length in lengths)])
            reasons |= {f"{name}, {n} frames": why for n, why in rates.items() if isinstance(why, str)}
        notes += tuple(f"No rate of {where}: {why}." for where, why in reasons.items())
    yield Table("Runtime of 1,000 frames (appendix)", ["component", "runtime (ms)", "share"], rows, notes[:2])
    yield Table("Frames per second (appendix)", ["method", *lengths], speeds, notes)


def _timing_setting(measured: Mapping[str, Any]) -> str:
    height, width = measured["image_size"]
    size, stride = measured["windows"]
    return (
        f"This run: {measured['device']}, {measured['dtype']}, {width} x {height} pixels, K = {size}, stride {stride}, "
        f"batch 1; pictures from and depth to host memory within the time, files without; median of "
        f"{measured['rounds']} rounds with extremes, after one that does not count. The parts of the runtime were "
        "timed one by one."
    )


def _rate(rates: Sequence[float] | str | None) -> str:
    """Median and extremes of frames a second of the rounds; a dash where a reason stands in their place."""
    if rates is None or isinstance(rates, str):
        return "-"
    return f"{statistics.median(rates):.1f} ({min(rates):.1f} to {max(rates):.1f})"
