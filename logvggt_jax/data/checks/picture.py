"""A picture of a data set's copy: frames, their depth, and the cameras seen from above (matplotlib, no display)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.colours import DEPTHS_IN_MATPLOTLIB
from logvggt_jax.data.checks.report import SequenceReport
from logvggt_jax.data.errors import MissingFiles
from logvggt_jax.data.readers.folder_dataset import FolderDataset
from logvggt_jax.errors import InputError, MissingPackage, install_line
from logvggt_jax.files import atomic_file
from logvggt_jax.frames import Frames, evenly_spaced
from logvggt_jax.geometry import camera_centres, unproject

_ARROWS = 40  # headings along a path
_POINTS = 3000  # of a frame, in the view from above


def check_picture_path(path: str | Path) -> Path:
    """`path` as `write_check_picture` needs it, checked before hours of work.

    Raises InputError for what is no PNG file's name, MissingFiles where its folder is missing, and MissingPackage
    naming the extra that brings matplotlib.
    """
    _figure_class()
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise InputError(f"{path}: expected the name of a PNG file for the picture, such as check.png")
    if not path.absolute().parent.is_dir():
        raise MissingFiles(f"{path.absolute().parent}: no such folder for the picture; make it or choose another")
    return path


def write_check_picture(path: Path, dataset: FolderDataset, sequences: Sequence[SequenceReport]) -> None:
    """Draws a row for each of `sequences`: its examples (up to two), their depth, cameras and points from above.

    Up is where the cameras' tops point on average.
    """
    figure = _figure_class()(figsize=(15.0, 3.0 * len(sequences)), layout="constrained")
    axes = figure.subplots(len(sequences), 5, squeeze=False)
    for row, sequence in zip(axes, sequences, strict=True):
        views = [dataset.read(sequence.name, [index]) for index in sequence.examples]
        names = dataset.frame_names(sequence.name)
        for axis in row[:4]:
            axis.set_axis_off()
        for place, (frames, index) in enumerate(zip(views, sequence.examples, strict=True)):
            _draw_frame(figure, row[2 * place : 2 * place + 2], frames, names[index])
        label = row[0].text(-0.04, 0.5, sequence.name, rotation=90, va="center", ha="right", fontsize=8)
        label.set(transform=row[0].transAxes, parse_math=False)
        _draw_from_above(row[4], dataset.extrinsics(sequence.name), views)
    figure.suptitle(dataset.title, fontsize=10)
    with atomic_file(path) as temporary:
        figure.savefig(temporary, dpi=110)


def view_from_above(extrinsics: np.ndarray) -> np.ndarray:
    """Axes [2, 3] float64 of the plane seen from above: right and up on the page, orthonormal, in the world.

    `extrinsics` are [T, 3|4, 4] world-to-camera, OpenCV axes. The page's vertical out of it is the mean of the cameras'
    upward directions, or for cameras that have no common one the direction in which they move least.
    """
    poses = np.asarray(extrinsics, np.float64)
    upward = -poses[:, 1, :3].mean(0)
    centres = camera_centres(poses)
    offsets = centres - centres.mean(0)
    spread = np.linalg.svd(offsets.T @ offsets)[2]
    length = np.linalg.norm(upward)
    above = upward / length if length > 0.1 else spread[2]
    # The page's horizontal is where the cameras move most.
    level = spread - np.outer(spread @ above, above)
    right = level[int(np.argmax(np.linalg.norm(level, axis=1) > 0.5))]
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(above, right)])


def _draw_frame(figure: Any, axes: Any, frames: Frames, name: str) -> None:
    depth = np.where(frames.depth[0] > 0, frames.depth[0], np.nan)
    axes[0].imshow(frames.images[0])
    axes[0].set_title(name, fontsize=8, parse_math=False)
    limit = float(np.nanpercentile(depth, 99)) if np.isfinite(depth).any() else 1.0
    drawn = axes[1].imshow(depth, cmap=DEPTHS_IN_MATPLOTLIB, vmax=limit)
    axes[1].set_title("depth (m)" if frames.metric else "depth", fontsize=8)
    figure.colorbar(drawn, ax=axes[1], fraction=0.04, pad=0.02).ax.tick_params(labelsize=6)


def _draw_from_above(axis: Any, extrinsics: np.ndarray, views: list[Frames]) -> None:
    if not np.isfinite(extrinsics).all():
        axis.set_axis_off()
        axis.text(0.5, 0.5, "no poses", ha="center", va="center", transform=axis.transAxes)
        return
    plane = view_from_above(extrinsics)
    for frames in views:
        depth = frames.depth[0]
        # The farthest would leave the cameras a dot.
        valid = (depth > 0) & (depth <= np.quantile(depth[depth > 0], 0.9) if depth.any() else False)
        points = unproject(depth, frames.intrinsics[0], frames.extrinsics[0])[valid]
        step = max(1, len(points) // _POINTS)
        x, y = plane @ points[::step].T
        axis.scatter(x, y, s=1, c=frames.images[0][valid][::step] / 255.0, linewidths=0)
    x, y = plane @ camera_centres(extrinsics.astype(np.float64)).T
    axis.plot(x, y, "-", color="C3", linewidth=1)
    axis.plot(x[:1], y[:1], "s", color="C3", markersize=5)
    chosen = evenly_spaced(len(extrinsics), _ARROWS)
    # The optical axis is the third row of a world-to-camera rotation.
    along = plane @ extrinsics[chosen, 2, :3].astype(np.float64).T
    axis.quiver(x[chosen], y[chosen], *along, color="C3", angles="xy", width=0.004, scale=15)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_title("from above; square: first camera", fontsize=8)
    axis.tick_params(labelsize=6)


def _figure_class() -> Any:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingPackage(f"the picture of a check needs matplotlib ({error}): {install_line('eval')}") from error
    return Figure
