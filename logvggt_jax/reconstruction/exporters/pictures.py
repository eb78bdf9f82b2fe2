"""A result's pictures at their own size, read from the source once more, or else as the result keeps them."""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from logvggt_jax.errors import InputError, one_line
from logvggt_jax.reconstruction.depth_files import ORIGINAL_FOLDER, original_file, read_picture, write_picture
from logvggt_jax.reconstruction.exporters.cloud import tracked
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.sources import Source, SourceFrame
from logvggt_jax.reconstruction.sources.record import reopen


def picture_size(result: Reconstruction) -> tuple[int, int]:
    """(H, W) of the pictures that `Pictures.of` would give."""
    if _keeps_originals(result):
        return result.image_size
    if result.source is not None:
        with contextlib.suppress(InputError):
            reopen(result.source)
            return result.image_size
    return result.depth_size


def _keeps_originals(result: Reconstruction) -> bool:
    return (result.folder / ORIGINAL_FOLDER).is_dir()


@dataclasses.dataclass(frozen=True)
class Pictures:
    """Pictures of all frames of a result, and the cameras that belong to their size.

    Attributes:
      result: whose frames they are.
      source: where they are read; None for what the result keeps.
      originals: whether the result keeps them at their own size, and they are read there.
    """

    result: Reconstruction
    source: Source | None
    originals: bool = False

    @classmethod
    def of(cls, result: Reconstruction) -> Pictures:
        """Those that a result keeps at their own size, or else of the source where it is still there; else the images
        of the result, and a warning says why."""
        if _keeps_originals(result):
            return cls(result, None, originals=True)
        if result.source is None:
            reason = "the result does not say where its frames came from"
        else:
            try:
                return cls(result, reopen(result.source))
            except InputError as error:
                reason = one_line(error)
        height, width = result.depth_size
        warnings.warn(
            f"pictures are the result's own, {width} x {height} pixels, as the source cannot be read again: {reason}",
            stacklevel=3,
        )
        return cls(result, None)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the pictures."""
        return self.result.image_size if self._at_own_size else self.result.depth_size

    @property
    def intrinsics(self) -> np.ndarray:
        """[N, 3, 3] float64, pixels of the pictures, centres at integers."""
        return self.result.intrinsics if self._at_own_size else self.result.depth_intrinsics

    @property
    def _at_own_size(self) -> bool:
        return self.originals or self.source is not None

    def read(self, pool: FramePool) -> Iterator[np.ndarray]:
        """The pictures in order, [H, W, 3] uint8 RGB.

        Raises:
          InputError: the source does not give a frame that it once gave.
        """
        if self.originals:
            yield from pool.map(self._original, iter(self.result.names))
            return
        if self.source is None:
            yield from pool.map(self.result.image, iter(range(self.result.num_frames)))
            return
        names = iter(self.result.names)
        wanted = next(names, None)
        for frame in pool.map(_load, self.source.loaders()):
            if wanted is None:
                return
            if frame is None or frame.name != wanted:
                continue
            if frame.image.shape[:2] != self.size:
                break
            yield frame.image
            wanted = next(names, None)
        if wanted is not None:
            raise InputError(
                f"{self.source.path}: frame {wanted!r} cannot be read as it was before; move the source away to export "
                "the images that the result keeps"
            )

    def _original(self, name: str) -> np.ndarray:
        return read_picture(original_file(self.result.folder, name), self.result.image_size)

    def write(self, folder: Path, stems: Sequence[str], *, progress: bool) -> list[str]:
        """Writes all pictures as JPEG into a folder, which is made; gives the names of the files."""
        folder.mkdir()
        files = [f"{stem}.jpg" for stem in stems]
        with FramePool() as pool:
            for file, image in zip(
                files, tracked(self.read(pool), "Images", len(files), progress=progress), strict=True
            ):
                pool.submit(write_picture, folder / file, image)
            pool.finish()
        return files


def _load(load: Callable[[], SourceFrame | None]) -> SourceFrame | None:
    return load()
