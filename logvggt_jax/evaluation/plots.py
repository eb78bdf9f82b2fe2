"""Pictures of results: trajectories seen from above and depth beside its truth (matplotlib, no display needed)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.evaluation.depth import align_depth
from logvggt_jax.evaluation.trajectory import align_trajectory
from logvggt_jax.geometry import camera_centres, invert


def trajectory_plot(path: Path, predicted_extrinsics: np.ndarray, true_extrinsics: np.ndarray) -> None:
    """Camera positions in the plane of their largest extent, the prediction aligned by a similarity.

    Args:
      path: PNG file; its folder is created.
      predicted_extrinsics: [N, 3|4, 4], world-to-camera. A prediction that cannot be aligned (static, straight) is
        left out and the plot says so.
      true_extrinsics: [N, 3|4, 4].
    """
    true = camera_centres(np.asarray(true_extrinsics, np.float64))
    curves = {"truth": true}
    note = ""
    try:
        poses = invert(np.asarray(predicted_extrinsics, np.float64))
        curves["prediction, aligned"] = align_trajectory(poses, invert(np.asarray(true_extrinsics, np.float64)))[
            :, :3, 3
        ]
    except ValueError:
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
    axis.set_xlabel("m")
    axis.set_ylabel("m")
    axis.legend()
    _save(figure, path)


def depth_panel(
    path: Path, images: np.ndarray, target: np.ndarray, prediction: np.ndarray, *, max_frames: int = 4
) -> None:
    """Rows of image, true depth, predicted depth (scaled to the truth by the clip's medians) and relative error.

    Args:
      path: PNG file; its folder is created.
      images: [T, H, W, 3] uint8.
      target: [T, H, W] metres, 0 = invalid (drawn white).
      prediction: [T, H, W].
      max_frames: evenly spaced frames of the clip that are drawn.
    """
    valid = target > 0
    scale = align_depth(prediction[valid], target[valid], "median")[0] if valid.any() else 1.0
    chosen = np.unique(np.linspace(0, len(images) - 1, max_frames).round().astype(int))
    limits = (float(target[valid].min()), float(np.percentile(target[valid], 99))) if valid.any() else (0.0, 1.0)
    aspect = images.shape[1] / images.shape[2]
    figure, axes = _figure(len(chosen), 4, (9.0, 2.3 * len(chosen) * aspect + 0.6))
    for row, t in enumerate(chosen):
        masked = np.where(valid[t], target[t], np.nan)
        error = np.abs(scale * prediction[t] - masked) / masked
        shown: list[tuple[str, np.ndarray, dict[str, Any]]] = [
            (f"frame {t}", images[t], {}),
            ("true depth", masked, {"vmin": limits[0], "vmax": limits[1], "cmap": "viridis"}),
            ("predicted", scale * prediction[t], {"vmin": limits[0], "vmax": limits[1], "cmap": "viridis"}),
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


def _figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, list[Any]]:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError(f'plots need matplotlib ({error}): pip install "logvggt-jax[eval]"') from error
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(np.ravel(figure.subplots(rows, columns, squeeze=False)))


def _save(figure: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.png")
    try:
        figure.savefig(temporary, dpi=130)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
