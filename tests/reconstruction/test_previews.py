"""Previews can be seen, and say what their colours mean."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from result_folder import SIZE, write_result

from logvggt_jax.colours import depth_picture
from logvggt_jax.reconstruction.depth_files import write_depth
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.previews import depth_range, preview, write_previews
from logvggt_jax.reconstruction.result import Reconstruction


def test_all_previews_of_a_sequence_are_on_one_scale(tmp_path: Path) -> None:
    write_result(tmp_path, 3)
    ramp = np.linspace(1, 4, SIZE[0] * SIZE[1]).reshape(SIZE)
    for index, depth in enumerate((ramp, ramp + 4, np.full(SIZE, np.nan))):
        write_depth(tmp_path / "depth" / f"{index}.npz", depth, np.ones(SIZE))
    result = Reconstruction.open(tmp_path)
    near, far = depth_range(result)
    assert abs(near - 1.1) < 0.05 and abs(far - 7.9) < 0.05
    with FramePool(1) as pool:
        write_previews(result, [0, 1, 2], pool)
        pool.finish()
    for index in range(3):
        picture = np.asarray(Image.open(tmp_path / "previews" / f"{index}.png"))
        assert picture.shape[0] == 512 * SIZE[0] // SIZE[1] and picture.shape[1] > 2 * 512
        shown = picture[8::16, 512 + 12 + 8 : 512 + 12 + 512 : 16]
        np.testing.assert_array_equal(shown, depth_picture(result.depth(index), near=near, far=far))


def test_a_result_without_previews_has_no_folder_of_them_and_says_nothing_of_it(tmp_path: Path) -> None:
    write_result(tmp_path, 2)
    result = Reconstruction.open(tmp_path)
    for frames in ([], [1]):
        with FramePool(1) as pool:
            write_previews(result, frames, pool)
            pool.finish()
        assert (tmp_path / "previews").exists() == ("previews/*.png" in result.summary()) == bool(frames)


def test_the_bar_runs_from_far_to_near_and_is_labelled() -> None:
    picture = preview(np.zeros((60, 600, 3), np.uint8), np.full((60, 600), 2.0), 1.0, 4.0, "m")
    assert picture.shape[0] == 60  # wide enough as it is
    strip = picture[:, 2 * 612 : 2 * 612 + 24]
    ends = depth_picture(np.array([[4.0, 1.0]]), near=1.0, far=4.0)[0]
    np.testing.assert_array_equal(strip[[0, -1], 5], ends)
    assert (picture[:, 2 * 612 + 30 :] < 100).any()


def test_a_sequence_without_depth_has_a_scale_all_the_same(tmp_path: Path) -> None:
    write_result(tmp_path, 1)
    write_depth(tmp_path / "depth" / "0.npz", np.zeros(SIZE), np.ones(SIZE))
    assert depth_range(Reconstruction.open(tmp_path)) == (1.0, 2.0)
