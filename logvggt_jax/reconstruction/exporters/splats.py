"""Gaussian splats as SuperSplat and other viewers and trainers of splats open them, one for each point of the cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from logvggt_jax.files import atomic_file
from logvggt_jax.reconstruction.exporters.cloud import whole_cloud
from logvggt_jax.reconstruction.points.cloud_file import ply_header
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction

_NUM_SPLATS = 500_000
_OPACITY = 0.95
# The spherical harmonic of degree 0.
_HARMONIC = 0.28209479177387814
_NEIGHBOURS = 3
_SCALES = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_PROPERTIES = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *_SCALES, *_ROTATION)


def export_splats(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Writes a ball at each point: its colour from everywhere, nearly opaque, as wide as its neighbours are far.

    The file has the layout of trained splats without view-dependent colours: logarithms of standard deviations in the
    world's units, logits of opacity, quaternions (w, x, y, z), harmonics of degree 0. Nothing has been trained: it is
    what training would start from. Axes are the result's own, y down, which viewers of splats expect.

    Args:
      result: the reconstruction.
      path: the PLY file.
      point_filter: which pixels become points; None for 500,000 points.
      progress: show a progress bar.
    """
    vertices = whole_cloud(result, point_filter or result.filtered(_NUM_SPLATS), progress=progress)
    widths = _widths(result, vertices)
    splats = np.zeros(len(vertices), [(name, "<f4") for name in _PROPERTIES])
    for axis in "xyz":
        splats[axis] = vertices[axis]
    for channel, name in enumerate(("red", "green", "blue")):
        splats[f"f_dc_{channel}"] = (vertices[name] / 255 - 0.5) / _HARMONIC
    splats["opacity"] = np.log(_OPACITY / (1 - _OPACITY))
    for name in _SCALES:
        splats[name] = np.log(widths)
    splats[_ROTATION[0]] = 1.0
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        stream.write(ply_header(splats.dtype, str(len(splats))).encode())
        stream.write(splats.data)


def _widths(result: Reconstruction, vertices: np.ndarray) -> np.ndarray:
    """Standard deviations [n]: the root mean square distance to the nearest neighbours.

    Balls of half of that let one see through a wall between them.

    What stands alone is no wider than the gap between the chosen pixels of its own frame, and what lies upon another
    point no narrower than a tenth of that.
    """
    points, frames = np.stack([vertices[axis] for axis in "xyz"], axis=-1), vertices["frame"]
    towards = result.extrinsics[frames, 2]
    depth = np.einsum("nc,nc->n", towards[:, :3], points) + towards[:, 3]
    height, width = result.depth_size
    gap = depth / result.depth_intrinsics[frames, 0, 0] * np.sqrt(height * width / np.bincount(frames)[frames])
    distances, _ = KDTree(points).query(points, _NEIGHBOURS + 1, workers=-1)
    return np.clip(np.sqrt(np.mean(distances[:, 1:] ** 2, axis=1)), gap / 10, gap)
