"""A pool of rooms rendered once and kept in memory or in a cache folder, for training at full speed."""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from logvggt_jax.data.cache_use import cache_in_use
from logvggt_jax.data.dataset import Dataset, check_indices, check_sequence
from logvggt_jax.data.rooms.same_rooms import SameRooms
from logvggt_jax.data.worker_processes import worker_pool
from logvggt_jax.errors import InputError, OutputExists
from logvggt_jax.files import atomic_folder, check_space, numpy_reading
from logvggt_jax.frames import Frames

_ARRAYS = ("images", "depth", "intrinsics", "extrinsics")
_SERIAL_PIXELS = 3e7  # fewer than this are rendered sooner than worker processes start


class RoomPool(SameRooms[Dataset]):
    """All frames of a `Rooms`, rendered by `render_pool`; the same bytes as reading `Rooms` itself.

    Costs 7 bytes a pixel (uint8 RGB, float32 depth): 1,500 rooms of 24 frames of 56 x 70 take 0.99 GB. A pool
    from a cache folder is memory-mapped: its pages are shared between processes and can be evicted, and pickling
    sends the folder's path only. Pickling a pool without a folder copies it.
    """

    def __init__(self, rooms: Dataset, arrays: dict[str, np.ndarray], folder: Path | None) -> None:
        super().__init__(rooms)
        self.folder = folder
        self._rows = {name: row for row, name in enumerate(rooms.sequences)}
        self._arrays = arrays

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_arrays": None if self.folder else self._arrays}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if self.folder:
            self._arrays = _open_arrays(self.folder, self.rooms)

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        """Copies of frames `indices`."""
        check_sequence(sequence, self._rows, "rooms")
        row = self._rows[sequence]
        checked = check_indices(indices, self.num_frames(sequence), f"rooms, {sequence}")
        parts = {name: np.asarray(self._arrays[name][row][checked]) for name in _ARRAYS}
        return Frames(**parts, metric=True)


def render_pool(
    rooms: Dataset,
    *,
    cache_dir: str | Path | None = None,
    workers: int | None = None,
    max_bytes: int = 8 * 2**30,
    progress: bool = True,
) -> RoomPool:
    """Renders every frame of `rooms`, or opens the cache where that was done before.

    Args:
      rooms: what to render.
      cache_dir: folder of caches; the pool goes to a sub-folder named by the options' digest, which appears only
        when complete. None keeps the pool in memory.
      workers: rendering processes, default one a core; 1 renders in this process, as small pools do anyway.
        Worker processes import the main script: guard it with `if __name__ == "__main__"`.
      max_bytes: the largest pool that is kept in memory.
      progress: show a progress bar.

    Raises:
      InputError: the pool in memory is larger than `max_bytes`, or the cache is damaged.
      DiskError: the folder's disk has no room for it.
    """
    shapes = _shapes(rooms)
    size = sum(int(np.prod(shape)) * dtype.itemsize for shape, dtype in shapes.values())
    if cache_dir is None:
        if size > max_bytes:
            raise InputError(
                f"{len(rooms.sequences)} rooms take {size / 1e9:.1f} GB of memory, more than the "
                f"{max_bytes / 1e9:.1f} GB that are kept there: give data.cache_dir a folder to keep them on "
                "disk, lower the source's num_rooms, num_frames, height or width, or let the device draw them "
                '(renderer="device")'
            )
        arrays = {name: np.empty(shape, dtype) for name, (shape, dtype) in shapes.items()}
        _render_into(arrays, rooms, workers, progress)
        return RoomPool(rooms, arrays, None)

    folder = Path(cache_dir).absolute() / f"rooms-{_digest(rooms)}"
    if not folder.exists():
        with cache_in_use(folder.parent, "rooms", ("rooms-*.partial",)):
            check_space(folder, size, "make room, give data.cache_dir another folder or draw fewer rooms")
            # Another process may finish the same pool meanwhile; its bytes are the same.
            with contextlib.suppress(OutputExists), atomic_folder(folder) as unfinished:
                maps: dict[str, np.ndarray] = {
                    name: np.lib.format.open_memmap(unfinished / f"{name}.npy", "w+", dtype, shape)
                    for name, (shape, dtype) in shapes.items()
                }
                _render_into(maps, rooms, workers, progress)
                for array in maps.values():
                    array.flush()  # type: ignore[attr-defined]
                del maps
                (unfinished / "options.json").write_text(json.dumps(_contents(rooms), indent=2) + "\n")
    return RoomPool(rooms, _open_arrays(folder, rooms), folder)


def _contents(rooms: Dataset) -> dict[str, Any]:
    """What decides all frames of a pool, as JSON values."""
    return {**rooms.identity, "sequences": [rooms.sequences[0], rooms.sequences[-1], len(rooms.sequences)]}


def _digest(rooms: Dataset) -> str:
    return hashlib.sha256(json.dumps(_contents(rooms), sort_keys=True).encode()).hexdigest()[:16]


def _shapes(rooms: Dataset) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    lead = (len(rooms.sequences), rooms.num_frames(rooms.sequences[0]))
    image = rooms.image_size(rooms.sequences[0])
    return {
        "images": ((*lead, *image, 3), np.dtype(np.uint8)),
        "depth": ((*lead, *image), np.dtype(np.float32)),
        "intrinsics": ((*lead, 3, 3), np.dtype(np.float32)),
        "extrinsics": ((*lead, 4, 4), np.dtype(np.float32)),
    }


def _open_arrays(folder: Path, rooms: Dataset) -> dict[str, np.ndarray]:
    arrays = {}
    for name, (shape, dtype) in _shapes(rooms).items():
        try:
            with numpy_reading():
                array = np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError) as error:
            raise InputError(f"{folder / name}.npy cannot be read ({error}): delete {folder} to render anew") from error
        if array.shape != shape or array.dtype != dtype:
            raise InputError(
                f"{folder / name}.npy holds {array.dtype} {array.shape}, expected {dtype} {shape}: "
                f"delete {folder} to render anew"
            )
        arrays[name] = array
    return arrays


def _render_into(arrays: dict[str, np.ndarray], rooms: Dataset, workers: int | None, progress: bool) -> None:
    pixels = arrays["depth"].size
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, disable=not progress) as bar:
        task = bar.add_task(f"rendering rooms ({7 * pixels / 1e9:.2f} GB)", total=len(rooms.sequences))
        for row, frames in enumerate(_rendered(rooms, _worker_count(pixels, workers))):
            for name in _ARRAYS:
                arrays[name][row] = getattr(frames, name)
            bar.advance(task)


def _worker_count(pixels: int, workers: int | None) -> int:
    if workers is not None and workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    if pixels < _SERIAL_PIXELS:
        return 1
    if workers is not None:
        return workers
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _rendered(rooms: Dataset, workers: int) -> Iterator[Frames]:
    if workers == 1:
        for sequence in rooms.sequences:
            yield _read_all(rooms, sequence)
        return
    with worker_pool(workers) as pool:
        yield from pool.map(_read_all, [rooms] * len(rooms.sequences), rooms.sequences, chunksize=4)


def _read_all(rooms: Dataset, sequence: str) -> Frames:
    return rooms.read(sequence, range(rooms.num_frames(sequence)))
