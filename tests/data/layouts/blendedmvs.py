"""BlendedMVS: float maps, a text file a camera, pairs of photographs that see the same."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from room_views import INTRINSICS, SIZE, RoomView, write_image

from layouts.layout import Layout, changed, written
from logvggt_jax.data.readers.blendedmvs import BlendedMVS

SCENE = "5bfe5ae0fe0ea555e6a969ca"
NUMBERS = (0, 1, 2, 7)
PAIRS = "4\n0\n2 1 900.5 2 30.25 \n1\n1 0 900.5 \n2\n3 1 10 3 70.5 0 30.25 \n7\n0 \n"
# The depth range at the end has two to four numbers; some are negative.
RANGES = ("1.5 0.1", "-1.5 0.1 128", "1.5 0.1 128 9.9", "1.5 0.1")


def pfm_bytes(depth: np.ndarray, *, big_endian: bool = False) -> bytes:
    header = f"Pf\n{depth.shape[1]} {depth.shape[0]}\n{'1.000000' if big_endian else '-1.000000'}\n"
    return header.encode() + np.flipud(depth).astype(">f4" if big_endian else "<f4").tobytes()


def camera_text(extrinsics: np.ndarray, intrinsics: np.ndarray = INTRINSICS, depth_range: str = "1.5 0.1") -> str:
    def rows(matrix: np.ndarray) -> str:
        return "".join(" ".join(f"{value:.9g}" for value in row) + " \n" for row in matrix)

    return f"extrinsic\n{rows(extrinsics)}\nintrinsic\n{rows(intrinsics)}\n{depth_range}\n"


def write_frame(scene: Path, name: str, seen: RoomView, *, depth_range: str = "1.5 0.1") -> None:
    for folder in ("cams", "rendered_depth_maps"):
        (scene / folder).mkdir(parents=True, exist_ok=True)
    for suffix, picture in (("", seen.picture), ("_masked", 0 * seen.picture)):
        write_image(scene / "blended_images" / f"{name}{suffix}.jpg", picture)
    (scene / "cams" / f"{name}_cam.txt").write_text(camera_text(seen.extrinsics, seen.intrinsics, depth_range))
    (scene / "rendered_depth_maps" / f"{name}.pfm").write_bytes(pfm_bytes(seen.depth))


def write(root: Path, views: Sequence[RoomView]) -> None:
    for number, seen, depth_range in zip(NUMBERS, views, RANGES, strict=True):
        write_frame(root / SCENE, f"{number:08d}", seen, depth_range=depth_range)
    (root / SCENE / "cams" / "pair.txt").write_text(PAIRS)
    (root / "textured_meshes").mkdir()


FILES = [
    f"{SCENE}/{name}"
    for name in ("blended_images/00000001.jpg", "rendered_depth_maps/00000001.pfm", "cams/00000001_cam.txt")
]
LAYOUT = Layout(
    BlendedMVS,
    SCENE,
    write,
    names=[f"{number:08d}" for number in NUMBERS],
    image=FILES[0],
    depth=FILES[1],
    needed=FILES,
    tables=(FILES[2],),
    depth_error=1e-6,
    picture_error=2.0,
    damages=(
        *(
            (rf"00000001_cam\.txt.*{complaint}", changed(FILES[2], change))
            for change, complaint in (
                (lambda data: data.replace(b"intrinsic\n", b"intrinsic\n1 1 "), "got 32 words"),
                (lambda data: data[: len(data) // 2], "expected 'extrinsic'"),
                (lambda data: data.replace(b"intrinsic\n", b"intrinsic\nx", 2), "expected numbers"),
            )
        ),
        (
            r"00000001_cam\.txt: intrinsics fx=0\.5 .* as 00000001\.jpg is",
            written(FILES[2], camera_text(np.eye(4), np.diag([0.5, 0.5, 1]))),
        ),
        *(
            (rf"00000001\.pfm.*{complaint}", written(FILES[1], content))
            for content, complaint in (
                (pfm_bytes(np.ones(SIZE))[:-8], "12288 bytes after its header, got 12280"),
                (pfm_bytes(np.ones(SIZE)).replace(b"Pf", b"PF", 1), "single-channel"),
                (pfm_bytes(np.ones(SIZE)).replace(b"-1.0", b"-1..", 1), "single-channel"),
                (b"Pf\n0 0\n-1\n", "0 x 0"),
            )
        ),
    ),
)
