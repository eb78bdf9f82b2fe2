"""COLMAP's models: binary or text, depth as 16-bit pictures or as COLMAP's own maps."""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from room_views import INTRINSICS, SIZE, RoomView, millimetres, write_image
from scipy.spatial.transform import Rotation

from layouts.layout import Layout, changed, removed
from logvggt_jax.data.readers.colmap import Colmap

NAME = "garden"
NAMES = ("view8.png", "view9.png", "view10.png", "view11.png")
CAMERA = 3
# COLMAP's first pixel has its centre at (0.5, 0.5).
PARAMETERS = (INTRINSICS[0, 0], INTRINSICS[1, 1], INTRINSICS[0, 2] + 0.5, INTRINSICS[1, 2] + 0.5)


def _poses(views: Sequence[RoomView]) -> list[tuple[str, list[float]]]:
    """Name, quaternion (w first) and translation of the pictures that are registered."""
    found = []
    for name, each in zip(NAMES, views, strict=True):
        if np.isfinite(each.pose).all():
            x, y, z, w = Rotation.from_matrix(each.extrinsics[:3, :3]).as_quat()
            found.append((name, [w, x, y, z, *each.extrinsics[:3, 3]]))
    return found[::-1]  # COLMAP's order is not the names'


def write_binary_model(model: Path, views: Sequence[RoomView]) -> None:
    model.mkdir(parents=True)
    height, width = SIZE
    camera = struct.pack("<IiQQ4d", CAMERA, 1, width, height, *PARAMETERS)
    (model / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
    content = struct.pack("<Q", len(_poses(views)))
    for number, (name, pose) in enumerate(_poses(views), 7):
        content += struct.pack("<I7dI", number, *pose, CAMERA) + name.encode() + b"\0"
        content += struct.pack("<Q", 2) + struct.pack("<2dq2dq", 1, 2, -1, 3, 4, 5)
    (model / "images.bin").write_bytes(content)


def write_text_model(model: Path, views: Sequence[RoomView], camera: str = "PINHOLE {} {} {} {} {} {}") -> None:
    model.mkdir(parents=True)
    height, width = SIZE
    text = f"# Camera list\n{CAMERA} {camera.format(width, height, *PARAMETERS)}\n"
    (model / "cameras.txt").write_text(text)
    lines = ["# Image list", "# Number of images: 4"]
    for number, (name, pose) in enumerate(_poses(views), 7):
        # The first has no keypoints.
        lines += [f"{number} {' '.join(map(repr, map(float, pose)))} {CAMERA} {name}", "1 2 -1 3 4 5" * (number > 7)]
    (model / "images.txt").write_text("\n".join(lines) + "\n")


def write_pictures(folder: Path, views: Sequence[RoomView]) -> None:
    for name, each in zip(NAMES, views, strict=True):
        write_image(folder / "images" / name, each.picture)


def write_depth_map(folder: Path, name: str, depth: np.ndarray) -> None:
    maps = folder / "stereo/depth_maps"
    maps.mkdir(parents=True, exist_ok=True)
    height, width = depth.shape
    content = f"{width}&{height}&1&".encode() + depth.astype("<f4").tobytes()
    (maps / f"{name}.geometric.bin").write_bytes(content)


def write(root: Path, views: Sequence[RoomView]) -> None:
    folder = root / NAME
    write_pictures(folder, views)
    write_binary_model(folder / "sparse/0", views)
    for name, each in zip(NAMES, views, strict=True):
        write_image(folder / "depth" / name, millimetres(each.depth))


TABLES = tuple(f"{NAME}/sparse/0/{table}.bin" for table in ("cameras", "images"))
LAYOUT = Layout(
    Colmap,
    NAME,
    write,
    names=NAMES,
    image=f"{NAME}/images/view9.png",
    depth=f"{NAME}/depth/view9.png",
    needed=(f"{NAME}/images/view9.png", *TABLES),
    tables=TABLES,
    depth_error=0.00051,
    poses="rigid",
    damages=(
        (r"cameras\.bin: truncated or damaged", changed(TABLES[0], lambda data: data + b"\0")),
        (r"cameras\.bin: no camera 3", changed(TABLES[0], lambda data: data[:8] + b"\4" + data[9:])),
        (r"cameras\.bin, camera 3: COLMAP has no model 99", changed(TABLES[0], lambda x: x[:12] + b"\x63" + x[13:])),
        (r"images\.bin: '\.\./view8\.png' is no", changed(TABLES[1], lambda x: x.replace(b"view8", b"../view8"))),
        (r"images/viewX\.png: no such file, but .*images\.bin", changed(TABLES[1], lambda x: x.replace(b"w9", b"wX"))),
        (
            r"images\.bin, image 7 'view11\.png': expected a unit",
            changed(TABLES[1], lambda x: x[:12] + bytes(32) + x[44:]),
        ),
        (r"images\.bin: no such file", removed(TABLES[1])),
    ),
)
