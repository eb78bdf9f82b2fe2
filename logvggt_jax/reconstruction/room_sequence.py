"""A procedural room on disk, laid out as a 7-Scenes sequence, for trying things out without data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.progress import track

from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.files import FolderKind, atomic_folder, check_output
from logvggt_jax.frames import Frames
from logvggt_jax.geometry import invert
from logvggt_jax.reconstruction.depth_files import write_picture

INTRINSICS_FILE = "intrinsics.txt"
_SEQUENCE = FolderKind(INTRINSICS_FILE, (INTRINSICS_FILE, "frame-*"))
# Of a frame: drawing it takes 120 bytes of memory a pixel, 2 GB in all.
_MOST_PIXELS = 4096 * 4096


def write_room_sequence(
    output: str | Path,
    *,
    num_frames: int,
    image_size: tuple[int, int],
    seed: int = 0,
    split: str = "test",
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Renders a room along its camera path into a folder.

    Every frame has `frame-000000.color.png` (8-bit RGB), `.depth.proj.png` (16-bit millimetres of z-depth in the
    colour camera) and `.pose.txt` (camera-to-world, 4 x 4, metres); `intrinsics.txt` holds the 3 x 3 matrix in
    pixels, centres at integers.

    Args:
      output: the folder to make.
      num_frames: length of the sequence; the camera is once round its path after 96 frames.
      image_size: (H, W) in pixels.
      seed: of the room.
      split: `train`, `val` or `test`: rooms that a model trained on `train` has seen or not.
      overwrite: replace an earlier sequence.
      progress: show a progress bar.

    Returns:
      The folder.

    Raises:
      FileExistsError: `output` exists.
      ValueError: a parameter is out of range.
    """
    height, width = image_size
    if height * width > _MOST_PIXELS:
        raise InputError(f"image size {height}x{width} is too large: rooms have at most {_MOST_PIXELS:,} pixels")
    rooms = Rooms(split, height=height, width=width, num_frames=num_frames, num_rooms=1, seed=seed)
    sequence = rooms.sequences[0]
    target = check_output(output, overwrite=overwrite, kind=_SEQUENCE)
    with atomic_folder(target, replace=overwrite) as folder, disk_errors(target):
        steps = track(range(num_frames), description=f"Rendering {sequence}", disable=not progress)
        for index in steps:
            frames = rooms.read(sequence, [index])
            stem = f"frame-{index:06d}"
            write_picture(folder / f"{stem}.color.png", frames.images[0])
            millimetres = np.clip(np.rint(frames.depth[0] * 1000.0), 0, 65534).astype(np.uint16)
            write_picture(folder / f"{stem}.depth.proj.png", millimetres)
            np.savetxt(folder / f"{stem}.pose.txt", invert(frames.extrinsics[0].astype(np.float64)), fmt="%.9g")
        intrinsics, _ = rooms.cameras(sequence, [0])
        np.savetxt(folder / INTRINSICS_FILE, intrinsics[0], fmt="%.9g")
    return Path(output)


def read_room_sequence(folder: str | Path) -> Frames:
    """All frames of a folder that `write_room_sequence` has made, depth to the millimetre that its files keep.

    Raises MissingInput where it is no such folder, InputError for a damaged picture.
    """
    folder = Path(folder)
    stems = sorted(path.name.removesuffix(".color.png") for path in folder.glob("frame-*.color.png"))
    if not stems:
        raise MissingInput(f"{folder}: holds no frame-*.color.png; give the output of `logvggt render-room`")
    with disk_errors(folder):
        poses = np.stack([np.loadtxt(folder / f"{stem}.pose.txt") for stem in stems])
        intrinsics = np.loadtxt(folder / INTRINSICS_FILE)
    millimetres = np.stack([read_depth(folder / f"{stem}.depth.proj.png") for stem in stems])
    return Frames(
        images=np.stack([read_rgb(folder / f"{stem}.color.png") for stem in stems]),
        depth=millimetres.astype(np.float32) / 1000.0,
        intrinsics=np.tile(intrinsics, (len(stems), 1, 1)).astype(np.float32),
        extrinsics=invert(poses).astype(np.float32),
        metric=True,
    )
