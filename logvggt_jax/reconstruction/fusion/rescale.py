"""Metres for a result whose lengths are up to one common scale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from logvggt_jax.data.formats.image import read_depth as read_depth_picture
from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.files import open_regular, user_path
from logvggt_jax.geometry import camera_centres, points_at
from logvggt_jax.reconstruction.exporters.frame_names import file_stems
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.fusion.derived_result import check_derived, write_derived
from logvggt_jax.reconstruction.fusion.fuse import Fused, align, match
from logvggt_jax.reconstruction.fusion.same_view import is_same_view, may_be_cut
from logvggt_jax.reconstruction.result import Reconstruction

# Pixels of a frame that its depth and a sensor's must share.
_FEWEST = 50


def rescale(
    result: Reconstruction,
    output: str | Path,
    *,
    poses: str | Path | None = None,
    depth: str | Path | None = None,
    depth_unit: float | None = None,
    frames: tuple[str | int, str | int] | None = None,
    pixels: tuple[str, str] | None = None,
    distance: float | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> Fused:
    """Makes a result in metres: all lengths times one factor, nothing else changes. One way to know it is given.

    Args:
      result: the reconstruction, which is only read.
      output: folder of the new result.
      poses: cameras in metres, see `read_poses`.
      depth: folder with a sensor's depth, 16-bit PNG files whose names begin as the frames'.
      depth_unit: metres that a level of these is; None for 0.001.
      frames: two frames by name or number from 0, whose cameras are `distance` apart.
      pixels: two pixels as FRAME,U,V (of the original images, centres at integers), whose points are `distance` apart.
      distance: metres.
      overwrite: replace an earlier result.
      progress: show a progress bar.

    Raises:
      OutputExists: something is at `output`.
      InputError: no way or several are given, or the one does not tell a scale.
    """
    if sum(way is not None for way in (poses, depth, frames, pixels)) != 1:
        raise InputError("a scale comes from poses, depth, two frames or two pixels: give one of them")
    if distance is not None and frames is None and pixels is None:
        raise InputError("a distance is one between two frames or two pixels: poses and depth have metres already")
    if depth_unit is not None and depth is None:
        raise InputError("a unit of depth is that of a sensor's depth, which is not given: leave it out")
    read = [path for path in (poses, depth) if path is not None]
    check_derived(result, output, overwrite=overwrite, read=read)
    notes: list[str] = []
    if poses is not None:
        similarity, said = align(result, match(result, poses, notes), poses)
        factor = similarity.scale
        notes.append(said)
    elif depth is not None:
        factor = _from_depth(result, user_path(depth), 0.001 if depth_unit is None else depth_unit, notes)
    elif frames is not None:
        centres = camera_centres(result.extrinsics[[find_frame(result, name) for name in frames]])
        factor = _from_distance(centres, distance, f"the cameras of {frames[0]} and {frames[1]}", notes)
    else:
        assert pixels is not None
        points = np.stack([_point(result, text) for text in pixels])
        factor = _from_distance(points, distance, f"{pixels[0]} and {pixels[1]}", notes)
        if may_be_cut(result):
            height, width = result.image_size
            notes.append(f"pixels are counted in the frames as they were cut, {width} x {height} from the centre")
    extrinsics = result.extrinsics.copy()
    extrinsics[:, :, 3] *= factor
    made = write_derived(
        result,
        output,
        frames=range(result.num_frames),
        extrinsics=extrinsics,
        depth_scales=np.full(result.num_frames, factor),
        intrinsics=result.intrinsics,
        metric=True,
        world_is_given=result.world_is_given,
        keeps_health=True,
        overwrite=overwrite,
        progress=progress,
    )
    return Fused(made, [*notes, f"all lengths are multiplied by {factor:.6g}"])


def find_frame(result: Reconstruction, frame: str | int) -> int:
    """The number of a frame that is given by its name, or else by its number; InputError where there is none."""
    if frame in result.names:
        return result.names.index(frame)
    text = str(frame)
    if text.isascii() and text.isdecimal() and int(text) < result.num_frames:
        return int(text)
    raise InputError(
        f"there is no frame {frame!r}: give a name such as {result.names[0]!r}, or a number from 0 to "
        f"{result.num_frames - 1}"
    )


def _from_distance(ends: np.ndarray, distance: float | None, what: str, notes: list[str]) -> float:
    if distance is None:
        raise InputError(f"how far {what} are apart is not said: give the distance in metres (--distance)")
    if not 0 < distance < np.inf:
        raise InputError(f"a distance must be above 0 metres, got {distance}")
    found = float(np.linalg.norm(ends[1] - ends[0]))
    if found <= 1e-9 * max(1e-9, float(np.abs(ends).max())):
        raise InputError(f"{what} are at one place in the result, which tells no scale: choose others")
    notes.append(f"{what} are {found:.5g} apart in the result, {distance:g} m in truth")
    return distance / found


def _point(result: Reconstruction, text: str) -> np.ndarray:
    """The point [3] in the world of a pixel FRAME,U,V of an original image."""
    name, *numbers = text.rsplit(",", 2)
    try:
        u, v = (float(number) for number in numbers)
    except ValueError:
        raise InputError(f"expected a pixel as FRAME,U,V, got {text!r}") from None
    index = find_frame(result, name)
    (height, width), (rows, columns) = result.image_size, result.depth_size
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        raise InputError(f"pixel {text!r} lies outside of the image, which has {width} x {height} pixels")
    column = min(columns - 1, int((u + 0.5) * columns / width))
    row = min(rows - 1, int((v + 0.5) * rows / height))
    depth = result.depth(index)
    if not (np.isfinite(depth[row, column]) and depth[row, column] > 0):
        raise InputError(f"pixel {text!r} has no depth in the result: choose another")
    here = np.array([[u, v]])
    return points_at(here, depth[[row], [column]], result.intrinsics[index], result.extrinsics[index])[0]


def _from_depth(result: Reconstruction, folder: Path, unit: float, notes: list[str]) -> float:
    if not 0 < unit < np.inf:
        raise InputError(f"the unit of depth must be above 0 metres, got {unit}")
    files = _depth_files(result, folder)
    if not files:
        raise InputError(
            f"{folder} holds no 16-bit grey PNG file whose name begins with that of a frame, such as "
            f"{result.names[0]}.png"
        )
    with FramePool() as pool:
        found = list(pool.map(lambda item: _ratios(result, *item, unit), iter(files.items())))
    ratios = np.array([ratio for ratio in found if ratio is not None])
    if not len(ratios):
        raise InputError(
            f"{folder}: none of {len(files)} depth maps has {_FEWEST} pixels where the result has depth too"
        )
    factor = float(np.median(ratios))
    deviation = float(np.median(np.abs(ratios / factor - 1)))
    notes.append(
        f"sensor depth of {len(ratios)} of {result.num_frames} frames; a frame's own scale differs from the common one "
        f"by {deviation:.2%} (median; most {np.abs(ratios / factor - 1).max():.2%})"
    )
    return factor


def _depth_files(result: Reconstruction, folder: Path) -> dict[int, Path]:
    if not folder.is_dir():
        raise MissingInput(f"{folder} is no folder: expected one of 16-bit PNG files, a sensor's depth")
    with disk_errors(folder):
        pictures = [path for path in sorted(folder.iterdir()) if path.suffix.lower() == ".png"]
    names: dict[str, int] = {}
    for choices in (file_stems(result.names), result.names):
        names |= {name: index for index, name in enumerate(choices)}
    found: dict[int, Path] = {}
    for path in pictures:
        # frame-000001.depth.proj.png belongs to frame-000001.
        parts = path.name.split(".")
        starts: Sequence[str] = [".".join(parts[:end]) for end in range(len(parts) - 1, 0, -1)]
        index = next((names[start] for start in starts if start in names), None)
        if index is not None and index not in found and _is_deep(path):
            found[index] = path
    return found


def _is_deep(path: Path) -> bool:
    """Whether a PNG file has 16 bits of grey a pixel, by its header: colour may lie beside depth under one name."""
    with disk_errors(path), open_regular(path) as stream:
        header = stream.read(26)
    return header[24:26] == b"\x10\x00"


def _ratios(result: Reconstruction, index: int, path: Path, unit: float) -> float | None:
    """By how much a sensor's depth exceeds the result's, the median over the pixels; None where they share too few.

    Raises InputError where the sensor's does not show what the frame shows.
    """
    depth, sensor = result.depth(index), read_depth_picture(path).astype(np.float32) * unit
    if not is_same_view(result, sensor.shape):
        (rows, columns), (height, width) = sensor.shape, result.image_size
        raise InputError(
            f"{path} has {columns} x {rows} pixels and does not show what frame {result.names[index]} shows, which has "
            f"{width} x {height}: turn or cut the sensor's depth as the frames were"
        )
    sensor = cv2.resize(sensor, depth.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    with np.errstate(invalid="ignore"):
        valid = (sensor > 0) & (sensor < (2**16 - 1) * unit) & np.isfinite(depth) & (depth > 0)
    return float(np.median(sensor[valid] / depth[valid])) if valid.sum() >= _FEWEST else None
