"""Masks beside exported pictures: black where a result's masks have dropped pixels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from logvggt_jax.data.feeding.transforms import ResizeTransform
from logvggt_jax.reconstruction.depth_files import write_picture
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.result import Reconstruction


def write_masks(result: Reconstruction, folder: Path, files: Sequence[str], size: tuple[int, int]) -> None:
    """Makes a folder with a mask file, grey of 8 bits, for each picture of `size` (H, W).

    Those of the result are enlarged by their nearest pixels.
    """
    folder.mkdir()
    transform = ResizeTransform(original_size=size, size=result.depth_size)

    def write(index: int) -> None:
        kept = transform.depth_to_original(result.confidence(index) != 0)
        write_picture(folder / files[index], np.where(kept, np.uint8(255), np.uint8(0)))

    with FramePool() as pool:
        for _ in pool.map(write, iter(range(len(files)))):
            pass
