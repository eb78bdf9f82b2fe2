"""PointOdyssey v1.2: 16-bit depth up to 1000 m, cameras in an npz file beside large point tracks."""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from room_views import RoomView, write_image

from layouts.layout import VIEWS, Layout, changed, removed
from logvggt_jax.data.readers.pointodyssey import PointOdyssey

STEP = 1000 / 65535


def write_cameras(folder: Path, views: Sequence[RoomView] = VIEWS, **changes: np.ndarray | None) -> None:
    count = len(views)
    arrays: dict[str, np.ndarray | None] = {
        "trajs_2d": np.zeros((count, 5, 2), np.float32),
        "trajs_3d": np.zeros((count, 5, 3), np.float32),
        "visibs": np.ones((count, 5), bool),
        "valids": np.ones((count, 5), bool),
        "intrinsics": np.stack([each.intrinsics for each in views]).astype(np.float32),
        "extrinsics": np.stack([each.extrinsics for each in views]).astype(np.float32),
    }
    np.savez(folder / "anno.npz", **{name: array for name, array in (arrays | changes).items() if array is not None})


def write_sequence(folder: Path, views: Sequence[RoomView] = VIEWS) -> None:
    for index, each in enumerate(views):
        write_image(folder / f"rgbs/rgb_{index:05d}.jpg", each.picture)
        write_image(folder / f"depths/depth_{index:05d}.png", np.rint(each.depth / STEP).astype(np.uint16))
        write_image(folder / f"masks/mask_{index:05d}.png", each.picture)
    write_cameras(folder, views)


def write(root: Path, views: Sequence[RoomView]) -> None:
    write_sequence(root / SCENE, views)


def flipped(content: bytes) -> bytes:
    """Bytes of the extrinsics' numbers that are others."""
    start = content.index(b"extrinsics.npy")
    return content[: start + 200] + bytes(40) + content[start + 240 :]


def write_emptied(path: Path) -> None:
    """Writes the archive anew with no bytes in its intrinsics."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, b"" if name == "intrinsics.npy" else content)


SCENE = "train/dancing"
FILES = [f"{SCENE}/{name}" for name in ("rgbs/rgb_00001.jpg", "depths/depth_00001.png", "anno.npz")]
LAYOUT = Layout(
    PointOdyssey,
    SCENE,
    write,
    names=[f"rgb_{index:05d}" for index in range(4)],
    image=FILES[0],
    depth=FILES[1],
    needed=FILES,
    tables=(FILES[2],),
    depth_error=0.51 * STEP,
    picture_error=2.0,
    damages=(
        (r"anno\.npz: .*valids.*fetch v1\.2", lambda root: write_cameras(root / SCENE, valids=None)),
        (
            r"anno\.npz.*annotations\.npz is of an older release.*fetch v1\.2",
            lambda root: (root / FILES[2]).rename(root / "train/dancing/annotations.npz"),
        ),
        (
            "train/dancing: expected frames 0 to 3.*got 3 frames from 0 to 2",
            removed(f"{SCENE}/rgbs/rgb_00003.jpg", f"{SCENE}/depths/depth_00003.png"),
        ),
        (
            "got 4 frames from 0 to 4",
            lambda root: [
                (root / SCENE / stem.format(3)).rename(root / SCENE / stem.format(4))
                for stem in ("rgbs/rgb_{:05d}.jpg", "depths/depth_{:05d}.png")
            ],
        ),
        (r"anno\.npz: truncated or damaged", changed(FILES[2], lambda data: data[:-50])),
        (r"anno\.npz: truncated or damaged", changed(FILES[2], flipped)),
        (r"anno\.npz: expected intrinsics of 3 x 3 numbers", lambda root: write_emptied(root / FILES[2])),
        (
            r"anno\.npz: truncated or damaged",
            lambda root: [np.save(root / "a.npy", np.eye(4)), (root / "a.npy").rename(root / FILES[2])],
        ),
        *(
            (
                r"anno\.npz: expected (in|ex)trinsics of",
                lambda root, change={name: array}: write_cameras(root / SCENE, **change),
            )
            for name, array in (
                ("intrinsics", np.zeros((2, 3, 3))),
                ("extrinsics", np.zeros((3, 3, 4))),
                ("extrinsics", np.zeros((0, 4, 4))),
                ("extrinsics", np.array("none")),
            )
        ),
        (
            r"anno\.npz: truncated or damaged.*allow_pickle",
            lambda root: write_cameras(root / SCENE, extrinsics=np.array([{}, {}, {}], dtype=object)),
        ),
        (
            r"anno\.npz: intrinsics fx=-55 .* as rgb_00000\.jpg is",
            lambda root: write_cameras(root / SCENE, intrinsics=np.stack([np.diag([-55.0, 55, 1])] * 4)),
        ),
    ),
)
