"""Pictures without cameras: in the order of their names, one folder or many."""

from pathlib import Path

import numpy as np
import pytest
from absl import logging
from room_views import write_image

from logvggt_jax.data import check_frames, open_dataset
from logvggt_jax.data.errors import MissingFiles
from logvggt_jax.errors import InputError


def write_video(folder: Path, numbers: tuple[int, ...] = (1, 2, 10)) -> Path:
    for number in numbers:
        write_image(folder / f"img{number}.png", np.full((28, 42, 3), number, np.uint8))
    (folder / "notes.txt").write_text("no picture")
    return folder


def test_pictures_come_in_natural_order_without_depth_or_poses(tmp_path: Path):
    write_video(tmp_path / "walk")
    write_video(tmp_path / "drive", (3,))
    (tmp_path / "empty").mkdir()
    dataset = open_dataset("images", tmp_path)
    assert dataset.sequences == ("drive", "walk")
    assert dataset.frame_names("walk") == ["img1.png", "img2.png", "img10.png"]
    frames = dataset.read("walk", [2, 0])
    assert frames.images[:, 0, 0, 0].tolist() == [10, 1] and not frames.depth.any() and not frames.metric
    assert np.isnan(frames.extrinsics).all()
    check_frames(frames, "walk", poses=False)
    with pytest.raises(InputError, match="extrinsics must be finite"):
        check_frames(frames, "walk")


def test_what_is_hidden_is_no_picture(tmp_path: Path):
    write_video(tmp_path / ".thumbnails")
    (write_video(tmp_path / "walk") / "._img1.png").write_bytes(b"\0\5\x16\7 what macOS knows of it")
    dataset = open_dataset("images", tmp_path)
    assert dataset.sequences == ("walk",) and dataset.frame_names("walk") == ["img1.png", "img2.png", "img10.png"]


def test_moments_before_the_first_are_in_their_order(tmp_path: Path):
    for time in ("-1.5", "-0.5", "0.25", "1"):
        write_image(tmp_path / f"walk/{time}.png", np.zeros((28, 42, 3), np.uint8))
    names = open_dataset("images", tmp_path).frame_names("walk")
    assert names == ["-1.5.png", "-0.5.png", "0.25.png", "1.png"]


def test_jpegs_of_other_suffixes_are_read_and_heic_is_counted_as_left_out(tmp_path: Path):
    write_image(tmp_path / "walk/1.jpg", np.full((28, 42, 3), 9, np.uint8))
    (tmp_path / "walk/1.jpg").rename(tmp_path / "walk/1.JFIF")
    (tmp_path / "walk/1.heic").write_bytes(b"\0\0\0\x18ftypheic")  # of which 1.JFIF was made
    (tmp_path / "walk/2.heic").write_bytes(b"\0\0\0\x18ftypheic")
    (tmp_path / "phone").mkdir()
    (tmp_path / "phone/1.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    dataset = open_dataset("images", tmp_path)
    assert dataset.read("walk", [0]).images[0, 0, 0].tolist() == [9, 9, 9]
    assert dataset.dropped_frames("walk") == {"HEIC or AVIF: convert it to JPEG": 1}
    with pytest.raises(InputError, match=r"phone: no frame .*'HEIC or AVIF: convert it to JPEG': 1"):
        dataset.num_frames("phone")


def test_heic_beside_folders_of_pictures_hides_none_of_them(tmp_path: Path):
    write_video(tmp_path / "walk")
    (tmp_path / "cover.heic").write_bytes(b"\0\0\0\x18ftypheic")
    assert open_dataset("images", tmp_path).sequences == ("walk",)
    alone = tmp_path / "phone"
    alone.mkdir()
    (tmp_path / "cover.heic").rename(alone / "cover.heic")
    with pytest.raises(InputError, match=r"phone: no frame .*convert it to JPEG"):
        open_dataset("images", alone).num_frames("phone")


def test_a_picture_that_hides_folders_of_pictures_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    told: list[str] = []
    monkeypatch.setattr(logging, "warning", lambda text, *values: told.append(text % values))
    write_video(tmp_path / "walk")
    assert open_dataset("images", tmp_path).sequences == ("walk",) and not told
    write_image(tmp_path / "cover.png", np.zeros((28, 42, 3), np.uint8))
    assert open_dataset("images", tmp_path).sequences == (tmp_path.name,)
    assert len(told) == 1 and "cover.png" in told[0] and "not looked into (walk)" in told[0]


def test_the_root_itself_may_hold_the_pictures(tmp_path: Path):
    assert open_dataset("images", write_video(tmp_path / "walk")).sequences == ("walk",)


def test_a_folder_without_pictures_is_named(tmp_path: Path):
    with pytest.raises(MissingFiles, match="no sequences of pictures of videos; expected pictures"):
        open_dataset("images", tmp_path)
