"""Pictures of results: trajectories, depth and point clouds beside their truth (matplotlib, no display needed)."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.colours import DEPTHS_IN_MATPLOTLIB
from logvggt_jax.errors import MissingPackage, install_line
from logvggt_jax.files import atomic_file
from logvggt_jax.frames import evenly_spaced
from logvggt_jax.geometry import camera_centres, invert
from logvggt_jax.metrics import NotMeasurable
from logvggt_jax.metrics.depth import align_depth, resize_depth
from logvggt_jax.metrics.trajectory import align_trajectory

# Paper, appendix on efficiency; its GPU is not named, so that only the shape can be compared.
_PAPER_FRAMES_PER_SECOND = {
    "paper, full": {100: 12.4, 200: 12.3, 500: 12.3, 1000: 11.9},
    "paper, online": {100: 11.5, 200: 10.8, 500: 9.4, 1000: 8.2},
}


def trajectory_plot(path: Path, predicted_extrinsics: np.ndarray, true_extrinsics: np.ndarray) -> None:
    """Camera positions in the plane of their largest extent, the prediction aligned by a similarity, as a PNG file.

    Extrinsics are [N, 3|4, 4], world-to-camera. A prediction that cannot be aligned (static, straight) is left out and
    the plot says so.
    """
    true = camera_centres(np.asarray(true_extrinsics, np.float64))
    curves = {"truth": true}
    note = ""
    try:
        poses = invert(np.asarray(predicted_extrinsics, np.float64))
        curves["prediction, aligned"] = align_trajectory(poses, invert(np.asarray(true_extrinsics, np.float64)))[
            :, :3, 3
        ]
    except NotMeasurable:
        note = "; the prediction stands still or is straight and cannot be aligned"
    # The two principal directions of the true positions show most of the path whatever the world's axes are.
    axes = np.linalg.svd(true - true.mean(0))[2][:2]
    figure, (axis,) = _figure(1, 1, (5.5, 5.0))
    for (label, positions), style in zip(curves.items(), ("k-", "C1.-")[: len(curves)], strict=True):
        x, y = axes @ (positions - true.mean(0)).T
        axis.plot(x, y, style, label=label, linewidth=1.2)
        axis.plot(x[0], y[0], "s", color=axis.lines[-1].get_color(), markersize=6)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_title(f"{len(true)} cameras, square: first frame{note}", fontsize=9, wrap=True)
    axis.set_xlabel("where the camera moves most (m)")
    axis.set_ylabel("across it (m)")
    axis.legend()
    _save(figure, path)


def depth_panel(
    path: Path, images: np.ndarray, target: np.ndarray, prediction: np.ndarray, *, max_frames: int = 4
) -> None:
    """Rows of image, true depth, predicted depth (scaled to the truth by medians) and relative error, as a PNG file.

    Images are [T, h, w, 3] uint8, the target [T, H, W] in metres, 0 = invalid (drawn white), the prediction [T, h, w],
    resized to the target where its size is another. `max_frames` evenly spaced frames are drawn; the medians are
    theirs.
    """
    chosen = evenly_spaced(len(images), max_frames)
    images, target, prediction = images[chosen], target[chosen], prediction[chosen]
    if prediction.shape != target.shape:
        prediction = resize_depth(prediction, (target.shape[1], target.shape[2]))
    valid = target > 0
    scale = align_depth(prediction[valid], target[valid], "median")[0] if valid.any() else 1.0
    limits = (float(target[valid].min()), float(np.percentile(target[valid], 99))) if valid.any() else (0.0, 1.0)
    aspect = target.shape[1] / target.shape[2]
    figure, axes = _figure(len(chosen), 4, (9.0, 2.3 * len(chosen) * aspect + 0.6))
    for row, t in enumerate(chosen):
        masked = np.where(valid[row], target[row], np.nan)
        error = np.abs(scale * prediction[row] - masked) / masked
        depths = {"vmin": limits[0], "vmax": limits[1], "cmap": DEPTHS_IN_MATPLOTLIB}
        shown: list[tuple[str, np.ndarray, dict[str, Any]]] = [
            (f"frame {t}", images[row], {}),
            ("true depth (m)", masked, depths),
            (
                "predicted depth (m)",
                scale * prediction[row],
                depths,
            ),
            ("relative error", error, {"vmin": 0.0, "vmax": 0.5, "cmap": "magma"}),
        ]
        for column, (title, picture, options) in enumerate(shown):
            axis = axes[4 * row + column]
            drawn = axis.imshow(picture, **options)
            axis.set_axis_off()
            if row == 0 or column == 0:
                axis.set_title(title, fontsize=8)
            if column:
                figure.colorbar(drawn, ax=axis, fraction=0.046, pad=0.03).ax.tick_params(labelsize=6)
    _save(figure, path)


def efficiency_plot(path: Path, report: Mapping[str, Any]) -> None:
    """Frames a second by length beside the paper's, both relative to the shortest, and the time by part, as a PNG file.

    `report` is as benchmarks/efficiency.py writes it: `device`, `speed` (rows of `mode`, `frames`, `frames_per_second`)
    and `parts` (by mode, rows of `name` and `seconds`) of `part_frames` frames.
    """
    figure, (rates, relative, parts) = _figure(1, 3, (13.0, 4.0))
    for mode in dict.fromkeys(row["mode"] for row in report["speed"]):
        rows = [row for row in report["speed"] if row["mode"] == mode]
        lengths = [row["frames"] for row in rows]
        medians = [float(np.median(row["frames_per_second"])) for row in rows]
        extremes = [[abs(pick(row["frames_per_second"]) - m) for row, m in zip(rows, medians, strict=True)]
                    for pick in (min, max)]  # fmt: skip
        rates.errorbar(lengths, medians, yerr=extremes, marker="o", capsize=3, label=mode)
        relative.plot(lengths, [m / medians[0] for m in medians], "o-", label=mode)
    for label, values in _PAPER_FRAMES_PER_SECOND.items():
        relative.plot(list(values), [v / next(iter(values.values())) for v in values.values()], "--", label=label)
    for axis, title in ((rates, "frames/s"), (relative, "frames/s over those of the shortest")):
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("frames of the sequence")
        axis.set_ylim(bottom=0)
        axis.legend(fontsize=7)
    for position, rows in enumerate(report["parts"].values()):
        bottom = 0.0
        for index, row in enumerate(rows):
            # One entry a part in the legend, not one a bar.
            name = row["name"] if position == 0 else None
            parts.bar(position, row["seconds"], bottom=bottom, color=f"C{index}", label=name)
            bottom += row["seconds"]
    parts.set_xticks(range(len(report["parts"])), list(report["parts"]), fontsize=7)
    parts.set_title(f"seconds by part, {report['part_frames']} frames", fontsize=9)
    parts.legend(fontsize=7)
    figure.suptitle(report["device"], fontsize=9)
    _save(figure, path)


def point_clouds(path: Path, prediction: np.ndarray, target: np.ndarray, colours: np.ndarray, view: np.ndarray) -> None:
    """Two clouds side by side as a PNG file, seen from behind and above one camera (orthographic, nearest point in
    front).

    The prediction [N, 3] lies in the world of the target [M, 3]. `colours` [N, 3] uint8 are the predicted points', and
    the true ones' where M = N (grey otherwise); `view` [4, 4] is that camera's world-to-camera matrix.
    """
    frame = target @ _viewing_rotation(view).T
    low, high = np.percentile(frame[:, :2], 1, axis=0), np.percentile(frame[:, :2], 99, axis=0)
    grey = colours if len(colours) == len(target) else np.full((len(target), 3), 120, np.uint8)
    clouds = {"prediction, aligned": (prediction, colours), "truth": (target, grey)}
    pictures = {
        f"{title}, {len(points):,} points": _rendered(points @ _viewing_rotation(view).T, shade, low, high)
        for title, (points, shade) in clouds.items()
    }
    height, width = next(iter(pictures.values())).shape[:2]
    figure, axes = _figure(1, 2, (10.0, 5.0 * height / width + 0.4))
    for axis, (title, picture) in zip(axes, pictures.items(), strict=True):
        axis.imshow(picture)
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    _save(figure, path)


def curves_plot(
    path: Path, curves: Mapping[str, Sequence[tuple[float, float]]], title: str, *, x_label: str, y_label: str
) -> None:
    """Named curves of (x, y), from zero upwards, as a PNG file."""
    figure, (axis,) = _figure(1, 1, (5.5, 4.0))
    for name, points in curves.items():
        axis.plot(*zip(*points, strict=True), ".-", label=name)
    axis.set_xlabel(x_label)
    axis.set_ylabel(y_label)
    axis.set_ylim(bottom=0)
    axis.set_title(title, fontsize=9)
    axis.legend(fontsize=8)
    _save(figure, path)


def length_plot(
    path: Path,
    panels: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]],
    title: str,
    *,
    logarithmic: Collection[str] = (),
) -> None:
    """One panel a quantity side by side, in each the curves of (frames, value) of named methods, as a PNG file.

    A method has one colour in all panels. Axes start at zero, but those of the panels named in `logarithmic`.
    """
    figure, axes = _figure(1, len(panels), (4.2 * len(panels), 4.6))
    names = list(dict.fromkeys(name for curves in panels.values() for name in curves))
    styles = {name: {"color": f"C{i % 10}", "linestyle": ("-", "--")[i // 10 % 2]} for i, name in enumerate(names)}
    for axis, (quantity, curves) in zip(axes, panels.items(), strict=True):
        for name, points in curves.items():
            if points:
                axis.plot(*zip(*points, strict=True), marker=".", label=name, **styles[name])
        axis.set_title(quantity, fontsize=9)
        axis.set_xlabel("frames of the sequence")
        if quantity in logarithmic:
            axis.set_yscale("log")
        else:
            axis.set_ylim(bottom=0)
    labelled: dict[str, Any] = {}
    for axis in axes:
        lines, labels = axis.get_legend_handles_labels()
        labelled |= dict(zip(labels, lines, strict=True))
    shown = [name for name in names if name in labelled]
    figure.legend([labelled[name] for name in shown], shown, loc="outside lower center", ncols=6, fontsize=8)
    figure.suptitle(title, fontsize=9)
    _save(figure, path)


def _viewing_rotation(view: np.ndarray) -> np.ndarray:
    """Axes of a viewer who looks along the camera, tilted down by 25 degrees."""
    angle = np.radians(25.0)
    tilt = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    return tilt @ np.asarray(view, np.float64)[:3, :3]


def _rendered(points: np.ndarray, colours: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Picture [H, W, 3] of points in the viewer's axes; white where there is none."""
    margin = 0.05 * (high - low) + 1e-9
    low, high = low - margin, high + margin
    width = 480
    height = int(np.clip(width * (high[1] - low[1]) / (high[0] - low[0]), 120, 720))
    picture = np.full((height, width, 3), 255, np.uint8)
    pixels = np.floor((points[:, :2] - low) / (high - low) * [width, height])
    inside = ((pixels >= 0) & (pixels < [width, height])).all(1)
    order = np.argsort(-points[inside, 2], kind="stable")  # the nearest last
    columns, rows = pixels[inside][order].astype(int).T
    picture[rows, columns] = colours[inside][order]
    return picture


def _figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, list[Any]]:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingPackage(f"plots need matplotlib ({error}): {install_line('eval')}") from error
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(np.ravel(figure.subplots(rows, columns, squeeze=False)))


def _save(figure: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary:
        figure.savefig(temporary, dpi=130)
