"""Co3Dv2: annotations in gzip JSON, PyTorch3D's cameras, depth as the bits of 16-bit floats."""

import gzip
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from analytic_room import pinhole
from room_views import RoomView, room_views, write_image

from layouts.layout import Layout, written
from logvggt_jax.data.readers.co3dv2 import Co3Dv2

LANDSCAPE, PORTRAIT = (48, 64), (64, 48)
NAME = "apple/110_13051_23361"
# Neither the order of the list, nor that of the file names, is the order in time.
FILE_NUMBERS, FRAME_NUMBERS = (9, 3, 7, 1), (4, 20, 25, 108)


def views_of(size: tuple[int, int]) -> list[RoomView]:
    return room_views(4, pinhole(size, 50.0, (size[1] / 2 + 1.25, size[0] / 2 - 2.5)), size)


def normalised_camera(extrinsics: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], kind: str) -> dict:
    """A viewpoint, by PyTorch3D's documentation: row vectors, x left, y up, coordinates of +1 at the left and upper
    border (of the shorter edge), pixels from 0 to W."""
    world_to_view = np.diag([-1.0, -1.0, 1.0, 1.0]) @ extrinsics
    height, width = size
    scale = np.array([min(size) / 2] * 2 if kind == "ndc_isotropic" else [width / 2, height / 2])
    centre = np.array([intrinsics[0, 2] + 0.5, intrinsics[1, 2] + 0.5])
    return {
        "R": world_to_view[:3, :3].T.tolist(),
        "T": world_to_view[:3, 3].tolist(),
        "focal_length": (np.array([intrinsics[0, 0], intrinsics[1, 1]]) / scale).tolist(),
        "principal_point": (-(centre - np.array([width, height]) / 2) / scale).tolist(),
        "intrinsics_format": kind,
    }


def write_depth(path: Path, depth: np.ndarray) -> None:
    write_image(path, np.asarray(depth, np.float16).view(np.uint16))


def write_mask(path: Path, mask: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), mask, [cv2.IMWRITE_PNG_BILEVEL, 1])


def write_gzip(path: Path, content: object) -> None:
    path.write_bytes(gzip.compress(json.dumps(content).encode()))


def read_gzip(path: Path) -> list:
    return json.loads(gzip.decompress(path.read_bytes()))


def add(path: Path, entries: list) -> None:
    write_gzip(path, (read_gzip(path) if path.exists() else []) + entries)


def edit(path: Path, change) -> None:
    """Applies `change` to every entry of an annotation file."""
    entries = read_gzip(path)
    for entry in entries:
        change(entry)
    write_gzip(path, entries)


def write_list(root: Path, category: str, name: str, **parts: list) -> None:
    folder = root / category / "set_lists"
    folder.mkdir(exist_ok=True)
    content = {"train": [], "val": [], "test": [], **parts}
    (folder / f"set_lists_{name}.json").write_text(json.dumps(content))


def write_sequence(
    root: Path, views: Sequence[RoomView], name: str = NAME, kind: str = "ndc_isotropic", scale: float = 1.5
) -> None:
    """Writes one sequence's files and adds it to its category's annotations."""
    category, sequence = name.split("/")
    frames = []
    for seen, file_number, frame_number in zip(views, FILE_NUMBERS, FRAME_NUMBERS, strict=True):
        size = seen.picture.shape[:2]
        stem = f"frame{file_number:06d}"
        image, depth = f"{name}/images/{stem}.jpg", f"{name}/depths/{stem}.jpg.geometric.png"
        depth_mask = f"{name}/depth_masks/{stem}.png"
        write_image(root / image, seen.picture)
        write_depth(root / depth, seen.depth / scale)
        write_mask(root / depth_mask, np.full(seen.depth.shape, 255, np.uint8))
        frames.append(
            {
                "sequence_name": sequence,
                "frame_number": frame_number,
                "frame_timestamp": frame_number / 10,
                "image": {"path": image, "size": list(size)},
                "depth": {"path": depth, "scale_adjustment": scale, "mask_path": depth_mask},
                "mask": {"path": f"{name}/masks/{stem}.png", "mass": 100.0},
                "viewpoint": normalised_camera(seen.extrinsics, seen.intrinsics, size, kind),
                "meta": {"frame_type": "train", "frame_splits": []},
            }
        )
    add(root / category / "frame_annotations.jgz", frames[2:] + frames[:2])
    quality = {"sequence_name": sequence, "category": category, "viewpoint_quality_score": 0.9}
    add(root / category / "sequence_annotations.jgz", [quality])


FILES = [
    f"{NAME}/{name}"
    for name in ("images/frame000003.jpg", "depths/frame000003.jpg.geometric.png", "depth_masks/frame000003.png")
]
ANNOTATIONS = "apple/frame_annotations.jgz"
LAYOUT = Layout(
    Co3Dv2,
    NAME,
    write_sequence,
    names=[f"frame{number:06d}" for number in FILE_NUMBERS],
    image=FILES[0],
    depth=FILES[1],
    needed=(*FILES, "apple/sequence_annotations.jgz"),
    tables=(ANNOTATIONS, "apple/sequence_annotations.jgz"),
    views=views_of(LANDSCAPE),
    depth_error=0.003,  # half floats between 2 and 4 are 1/512 apart
    picture_error=2.0,
    damages=(
        *(
            (f"apple/{name}: .*fetch it again", written(f"apple/{name}", content))
            for name in ("frame_annotations.jgz", "sequence_annotations.jgz")
            for content in (b"", b"[]", gzip.compress(b"{"), gzip.compress(b"{}"), gzip.compress(b"[3]"))
        ),
        *(
            (rf"frame_annotations\.jgz.*{complaint}", lambda root, change=change: edit(root / ANNOTATIONS, change))
            for change, complaint in (
                (
                    lambda each: each["viewpoint"].update(R=np.diag([1, 1, -1]).tolist()),
                    r"images/frame000\d+\.jpg: .*rigid",
                ),
                (lambda each: each["viewpoint"].update(T=[1, 2]), "fetch it again"),
                (lambda each: each["viewpoint"].update(intrinsics_format="pixels"), "'pixels'"),
                (lambda each: each["viewpoint"].pop("focal_length"), "focal_length"),
                (lambda each: each.pop("image"), "image"),
            )
        ),
        (f"{NAME}: no frame of Co3Dv2 counts", lambda root: write_gzip(root / ANNOTATIONS, [])),
        (
            r"depth_masks/frame000003\.png: size \(24, 32\)",
            lambda root: write_image(root / FILES[2], np.ones((24, 32), np.uint8)),
        ),
        (
            r"images/frame000003\.jpg: a picture of 48 x 64",
            lambda root: write_image(root / FILES[0], np.zeros((*PORTRAIT, 3), np.uint8)),
        ),
        (
            r"frame_annotations\.jgz: intrinsics fx=0\.024 .* as frame000009\.jpg is",
            lambda root: edit(root / ANNOTATIONS, lambda each: each["viewpoint"].update(focal_length=[1e-3, 1e-3])),
        ),
    ),
)
