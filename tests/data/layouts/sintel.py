"""MPI Sintel: binary depth and cameras byte by byte, numbered from 1."""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from room_views import INTRINSICS, RoomView, write_image

from layouts.layout import Layout, changed
from logvggt_jax.data.readers.sintel import Sintel

TAG = struct.pack("<f", 202021.25)


def write_depth(path: Path, depth: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = depth.shape
    path.write_bytes(TAG + struct.pack("<ii", width, height) + struct.pack(f"<{depth.size}f", *depth.ravel()))


def write_camera(path: Path, extrinsics: np.ndarray, intrinsics: np.ndarray = INTRINSICS) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(TAG + struct.pack("<9d", *intrinsics.ravel()) + struct.pack("<12d", *extrinsics[:3].ravel()))


def write(root: Path, views: Sequence[RoomView]) -> None:
    """Sequence alley_2, and the pass that is not read."""
    folder = root / "training"
    for number, each in enumerate(views, 1):
        name = f"alley_2/frame_{number:04d}"
        write_image(folder / f"final/{name}.png", each.picture)
        write_image(folder / f"clean/{name}.png", 255 - each.picture)
        write_depth(folder / f"depth/{name}.dpt", each.depth)
        write_camera(folder / f"camdata_left/{name}.cam", each.extrinsics, each.intrinsics)


FILES = [f"training/{name}" for name in ("final/alley_2/frame_0002.png", "depth/alley_2/frame_0002.dpt")]
CAMERA_FILE = "training/camdata_left/alley_2/frame_0002.cam"
LAYOUT = Layout(
    Sintel,
    "alley_2",
    write,
    names=[f"frame_{number:04d}" for number in range(1, 5)],
    image=FILES[0],
    depth=FILES[1],
    needed=(*FILES, CAMERA_FILE),
    tables=(CAMERA_FILE,),
    damages=(
        (
            r"frame_0002\.dpt: expected 12300 bytes for 64 x 48 pixels, got 12299",
            changed(FILES[1], lambda data: data[:-1]),
        ),
        (r"frame_0002\.dpt: expected 12300 bytes", changed(FILES[1], lambda data: data + b"\0")),
        (r"frame_0002\.dpt: .*for 64 x 0", changed(FILES[1], lambda data: data[:8])),
        (
            r"frame_0002\.dpt.*bytes for -1 x -3072 pixels",
            changed(FILES[1], lambda data: TAG + struct.pack("<ii", -1, -3072) + data[12:]),
        ),
        (r"frame_0002\.dpt.*tag 202021\.25", changed(FILES[1], lambda data: data[:4][::-1] + data[4:])),
        (r"frame_0002\.cam: expected 172 bytes, got 164", changed(CAMERA_FILE, lambda data: data[:-8])),
        (r"frame_0002\.cam.*tag 202021\.25", changed(CAMERA_FILE, lambda data: b"PIEX" + data[4:])),
        (r"frame_0002\.cam: intrinsics", lambda root: write_camera(root / CAMERA_FILE, np.eye(4), INTRINSICS.T)),
        ("training/final: no such folder", lambda root: (root / "training/final").rename(root / "training/albedo")),
    ),
)
