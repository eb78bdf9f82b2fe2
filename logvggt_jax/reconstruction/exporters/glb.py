"""GLB scenes for browsers, Blender and game engines: points, cameras, and a camera that flies the path; by trimesh."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.data.formats.calibration import OPENGL_AXES
from logvggt_jax.files import atomic_file
from logvggt_jax.frames import evenly_spaced
from logvggt_jax.geometry import invert, matrix_to_quaternion
from logvggt_jax.reconstruction.exporters.cloud import whole_cloud
from logvggt_jax.reconstruction.exporters.libraries import library
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.up_direction import up_direction

_NUM_POINTS = 500_000
_MOST_FRUSTA = 500
# Of the scene's extent.
_FRUSTUM_SIZE = 1 / 40
_FRAMES_PER_SECOND = 10.0
_CAMERA = "camera"
# The colours of points are linear in glTF, those of pictures are sRGB; shown as they are they would be pale.
_LEVELS = np.arange(256) / 255
_LINEAR = np.rint(255 * np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4)).astype(
    np.uint8
)
# Codes of the glTF specification.
_FLOAT = 5126


def export_glb(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Writes points, frusta of at most 500 cameras, and a camera that is animated along the path.

    Axes are glTF's, y up: those of the first camera (x right, y up, z backward), or of a world that poses have brought
    along, turned by right angles so that its axis nearest to what is up for the cameras becomes y. The cameras look
    through the middle of their pictures and keep their lens: the animated one has the median of the focal lengths. The
    animation has the frames' time stamps from the first on; where they are positions and not times, it shows ten
    frames a second.

    Args:
      result: the reconstruction.
      path: the file.
      point_filter: which pixels become points; None for 500,000 points.
      progress: show a progress bar.

    Raises:
      MissingPackage: trimesh is not installed.
    """
    trimesh = library("trimesh")
    vertices = whole_cloud(result, point_filter or result.filtered(_NUM_POINTS), progress=progress)
    turn = _turn(result)
    points = np.stack([vertices[axis] for axis in "xyz"], axis=-1) @ turn[:3, :3].T
    colours = _LINEAR[np.stack([vertices[channel] for channel in ("red", "green", "blue")], axis=-1)]
    poses = turn @ np.asarray(invert(result.extrinsics)) @ OPENGL_AXES
    scene = trimesh.Scene()
    if len(points):
        scene.add_geometry(trimesh.PointCloud(points, colours), node_name="points", geom_name="points")
    span = float(np.ptp(np.concatenate([points, poses[:, :3, 3]]), axis=0).max()) or 1.0
    shown = evenly_spaced(result.num_frames, _MOST_FRUSTA)
    lines = np.concatenate([_frustum(result, index, poses[index], span * _FRUSTUM_SIZE) for index in shown])
    scene.add_geometry(trimesh.load_path(lines), node_name="cameras", geom_name="cameras")

    def add_camera(buffers: dict[str, bytes], tree: dict[str, Any]) -> None:
        _add_camera(buffers, tree, result, poses, span)

    content = trimesh.exchange.gltf.export_glb(scene, buffer_postprocessor=add_camera)
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)


def _turn(result: Reconstruction) -> np.ndarray:
    """What turns the result's world so that y is up, [4, 4]; by right angles, so that coordinates are known again."""
    if not result.world_is_given:
        return OPENGL_AXES
    up = up_direction(result.extrinsics)
    axis, turn = int(np.abs(up).argmax()), np.zeros((4, 4))
    turn[1, axis] = np.sign(up[axis])
    if axis == 0:
        turn[0, 1] = -turn[1, 0]
    else:
        turn[0, 0] = 1
    turn[2, :3] = np.cross(turn[0, :3], turn[1, :3])
    turn[3, 3] = 1
    return turn


def _frustum(result: Reconstruction, index: int, pose: np.ndarray, depth: float) -> np.ndarray:
    """The eight edges [8, 2, 3] of what a camera sees up to a depth."""
    height, width = result.image_size
    matrix = result.intrinsics[index]
    corners = [(u, v) for u, v in ((0, 0), (width, 0), (width, height), (0, height))]
    rays = [((u - 0.5 - matrix[0, 2]) / matrix[0, 0], (v - 0.5 - matrix[1, 2]) / matrix[1, 1], 1.0) for u, v in corners]
    ends = pose[:3, 3] + depth * (np.array(rays) * OPENGL_AXES.diagonal()[:3]) @ pose[:3, :3].T
    apex = np.broadcast_to(pose[:3, 3], ends.shape)
    return np.concatenate([np.stack([apex, ends], 1), np.stack([ends, np.roll(ends, -1, 0)], 1)])


def _add_camera(
    buffers: dict[str, bytes], tree: dict[str, Any], result: Reconstruction, poses: np.ndarray, span: float
) -> None:
    """Adds the camera and its animation to a glTF document before its buffers are laid out (trimesh writes neither)."""
    height, width = result.image_size
    across = width / 2 / float(np.median(result.intrinsics[:, 0, 0]))
    upright = height / 2 / float(np.median(result.intrinsics[:, 1, 1]))
    tree["cameras"] = [
        {
            "type": "perspective",
            "perspective": {
                "aspectRatio": across / upright,
                "yfov": 2 * math.atan(upright),
                "znear": span / 1000,
            },
        }
    ]
    quaternions = matrix_to_quaternion(poses[:, :3, :3])
    # A quaternion and its negative are one rotation; the shorter way between neighbours is the one to take.
    flips = np.cumprod(np.where((quaternions[1:] * quaternions[:-1]).sum(1) < 0, -1.0, 1.0))
    quaternions[1:] *= flips[:, None]
    node = {
        "name": _CAMERA,
        "camera": 0,
        "translation": poses[0, :3, 3].tolist(),
        "rotation": quaternions[0].tolist(),
    }
    number = len(tree["nodes"])
    tree["nodes"].append(node)
    tree["scenes"][tree.get("scene", 0)]["nodes"].append(number)
    times = _accessor(buffers, tree, "times", _times(result.timestamps, result.timed), "SCALAR")
    samplers = [
        {"input": times, "interpolation": "LINEAR", "output": _accessor(buffers, tree, *track)}
        for track in (("translation", poses[:, :3, 3], "VEC3"), ("rotation", quaternions, "VEC4"))
    ]
    channels = [
        {"sampler": sampler, "target": {"node": number, "path": path}}
        for sampler, path in enumerate(("translation", "rotation"))
    ]
    tree["animations"] = [{"name": "camera path", "samplers": samplers, "channels": channels}]


def _accessor(buffers: dict[str, bytes], tree: dict[str, Any], name: str, values: np.ndarray, kind: str) -> int:
    """The number of a new accessor of these values."""
    values = np.asarray(values, np.float32)
    rows = values.reshape(len(values), -1)
    number = len(tree["accessors"])
    buffers[f"animation {name}"] = values.tobytes()
    tree["accessors"][f"animation {name}"] = {
        "bufferView": len(buffers) - 1,
        "componentType": _FLOAT,
        "count": len(values),
        "type": kind,
        "byteOffset": 0,
        "min": rows.min(0).tolist(),
        "max": rows.max(0).tolist(),
    }
    return number


def _times(timestamps: np.ndarray, timed: bool | None) -> np.ndarray:
    """Seconds [N] from the first frame on, increasing; those of frames that have positions for times are a tenth of a
    second apart. `timed` as of `Reconstruction`."""
    times = timestamps - timestamps[0]
    if timed is None:  # of earlier versions
        timed = not (timestamps[0] == 0 and (np.diff(times) == 1).all())
    if not timed or (np.diff(times.astype(np.float32)) <= 0).any():
        return np.arange(len(times)) / _FRAMES_PER_SECOND
    return times
