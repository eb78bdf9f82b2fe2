"""A room whose depth is known exactly, for tests of readers; shares no code with the package.

The room is a box seen from inside. World axes are OpenCV's (x right, y down, z forward); colours vary smoothly with
the place on the wall, so that lossy pictures come back nearly unchanged.
"""

import numpy as np

HALF_SIZE = np.array([2.5, 1.4, 3.0])


def pinhole(size: tuple[int, int], focal: float, centre: tuple[float, float] | None = None) -> np.ndarray:
    """Intrinsics [3, 3] for a picture of `size` (H, W), centres at integers."""
    cx, cy = centre or ((size[1] - 1) / 2, (size[0] - 1) / 2)
    return np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])


def camera_to_world(index: int) -> np.ndarray:
    """Pose [4, 4] number `index` of a smooth path: it turns, nods, rolls and moves."""
    yaw, pitch, roll = 0.3 + 0.07 * index, 0.05 * np.sin(index), 0.04 * np.cos(index)
    y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    z = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = y @ x @ z
    pose[:3, 3] = [0.12 * index - 0.3, 0.05 * np.cos(index), -0.1 * index + 0.2]
    return pose


def view(pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """What a camera at camera-to-world `pose` sees: picture [H, W, 3] uint8 RGB, z-depth [H, W] float64, metres."""
    v, u = np.indices(size).astype(np.float64)
    rays = np.stack([u, v, np.ones(size)], -1) @ np.linalg.inv(intrinsics).T  # z = 1: distance along it is z-depth
    directions, origin = rays @ pose[:3, :3].T, pose[:3, 3]
    with np.errstate(divide="ignore"):
        hits = np.where(directions > 0, HALF_SIZE - origin, -HALF_SIZE - origin) / directions
    depth = np.where(np.abs(directions) > 1e-12, hits, np.inf).min(-1)
    points = origin + depth[..., None] * directions
    picture = 128 + 90 * np.sin(points * [1.1, 1.7, 0.9] + [0.3, 1.0, 2.0])
    return np.rint(picture).astype(np.uint8), depth


def disagreement(frames, first: int, second: int) -> tuple[float, float]:
    """Median relative difference between the depth of frame `first` carried into `second` and what is there, and the
    share of pixels that could be compared; `frames` as the package's `Frames`."""
    depth = frames.depth[first].astype(np.float64)
    height, width = depth.shape
    v, u = np.nonzero(depth)
    rays = np.stack([u, v, np.ones(len(u))]).astype(np.float64)
    camera = np.linalg.inv(frames.intrinsics[first].astype(np.float64)) @ rays * depth[v, u]
    world = np.linalg.inv(frames.extrinsics[first].astype(np.float64)) @ np.vstack([camera, np.ones(len(u))])
    there = (frames.extrinsics[second].astype(np.float64) @ world)[:3]
    pixels = frames.intrinsics[second].astype(np.float64) @ there
    column, row = np.rint(pixels[:2] / np.where(pixels[2] > 0, pixels[2], np.nan)).astype(np.float64)
    inside = (there[2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = frames.depth[second][row[inside].astype(int), column[inside].astype(int)].astype(np.float64)
    known = found > 0
    return float(np.median(np.abs(found - there[2][inside])[known] / found[known])), known.sum() / max(depth.size, 1)
