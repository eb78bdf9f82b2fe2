"""Sources read what they should, in order, one frame at a time, and name what they cannot read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from logvggt_jax.reconstruction.sources import (
    FolderSource,
    SourceFrame,
    SourceOptions,
    image_folder,
    open_source,
)


def write_image(path: Path, value: int, size: tuple[int, int] = (20, 30)) -> None:
    """A picture whose red is `value` and whose green and blue are 0."""
    image = np.zeros((*size, 3), np.uint8)
    image[..., 2] = value
    assert cv2.imwrite(str(path), image)


def reds(frames: list[SourceFrame]) -> list[int]:
    return [int(frame.image[0, 0, 0]) for frame in frames]


def test_folder_is_in_natural_order_and_rgb(tmp_path: Path) -> None:
    for number in (10, 9, 1, 100, 2):
        write_image(tmp_path / f"img{number}.png", number)
    (tmp_path / "notes.txt").write_text("no image")
    write_image(tmp_path / ".hidden.png", 50)
    source = open_source(tmp_path)
    assert isinstance(source, FolderSource)
    frames = list(source)
    assert [frame.name for frame in frames] == ["img1", "img2", "img9", "img10", "img100"]
    assert reds(frames) == [1, 2, 9, 10, 100]
    assert frames[0].image[0, 0].tolist() == [1, 0, 0]
    assert frames[0].image.dtype == np.uint8
    assert len(source) == 5
    assert [frame.timestamp for frame in frames] == [0, 1, 2, 3, 4]


def test_seven_scenes_folder_gives_colour_images_only(tmp_path: Path) -> None:
    for index in range(3):
        write_image(tmp_path / f"frame-00000{index}.color.png", index + 1)
        depth = np.full((20, 30), 1000, np.uint16)
        assert cv2.imwrite(str(tmp_path / f"frame-00000{index}.depth.png"), depth)
    frames = list(open_source(tmp_path))
    assert reds(frames) == [1, 2, 3]
    assert [frame.name for frame in frames] == ["frame-000000", "frame-000001", "frame-000002"]


def test_names_differ_where_stems_do_not(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", 1)
    write_image(tmp_path / "a.jpg", 1)
    assert [frame.name for frame in open_source(tmp_path)] == ["a.jpg", "a.png"]


def test_stride_and_limit_keep_the_position_as_time(tmp_path: Path) -> None:
    for number in range(10):
        write_image(tmp_path / f"{number}.png", number)
    source = FolderSource(tmp_path, SourceOptions(stride=3, max_frames=3))
    assert reds(list(source)) == [0, 3, 6]
    assert [frame.timestamp for frame in source] == [0, 3, 6]
    assert len(source) == source.expected_frames == 3


def test_folder_reads_a_file_only_when_it_is_reached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(5):
        write_image(tmp_path / f"{number}.png", number)
    read: list[str] = []
    original = image_folder.read_rgb
    monkeypatch.setattr(image_folder, "read_rgb", lambda path: read.append(path.name) or original(path))
    frames = iter(open_source(tmp_path))
    assert read == []
    next(frames)
    next(frames)
    assert read == ["0.png", "1.png"]


def test_loaders_give_the_frames_in_whatever_order_they_are_called(tmp_path: Path) -> None:
    for number in range(6):
        write_image(tmp_path / f"{number}.png", 10 * number)
    source = open_source(tmp_path)
    loaders = list(source.loaders())
    loaded = [load() for load in reversed(loaders)][::-1]
    for frame, expected in zip(loaded, source, strict=True):
        assert frame[:2] == expected[:2]
        np.testing.assert_array_equal(frame.image, expected.image)


def test_missing_empty_and_wrong_sources_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"):
        open_source(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=f"no image in {tmp_path}"):
        open_source(tmp_path)
    write_image(tmp_path / "one.png", 1)
    with pytest.raises(ValueError, match="single image"):
        open_source(tmp_path / "one.png")
    with pytest.raises(ValueError, match="stride"):
        open_source(tmp_path, stride=0)
    with pytest.raises(ValueError, match="max_frames"):
        open_source(tmp_path, max_frames=0)


def test_images_of_two_sizes_name_both(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", 1, (20, 30))
    write_image(tmp_path / "b.png", 1, (24, 30))
    with pytest.raises(ValueError, match=r"b\.png is 30 x 24 pixels but a\.png is 30 x 20"):
        list(open_source(tmp_path))


def test_truncated_image_is_named(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", 1)
    path = tmp_path / "b.png"
    noise = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    assert cv2.imwrite(str(path), noise)
    path.write_bytes(path.read_bytes()[:600])
    frames = iter(open_source(tmp_path))
    next(frames)
    with pytest.raises(ValueError, match=r"b\.png"):
        next(frames)
