"""Videos are read in order, one frame at a time, and name what they cannot read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from logvggt_jax.reconstruction.sources import (
    SourceFrame,
    SourceOptions,
    VideoSource,
    open_source,
)


def write_video(path: Path, count: int, *, rate: float = 10.0) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), rate, (64, 48))
    assert writer.isOpened()
    for index in range(count):
        writer.write(np.full((48, 64, 3), 10 * index, np.uint8))
    writer.release()


def reds(frames: list[SourceFrame]) -> list[int]:
    return [int(frame.image[0, 0, 0]) for frame in frames]


def test_loaders_give_the_frames_in_whatever_order_they_are_called(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.mp4", 6)
    source = open_source(tmp_path / "clip.mp4")
    loaded = [load() for load in reversed(list(source.loaders()))][::-1]
    for frame, expected in zip(loaded, source, strict=True):
        assert frame is not None and frame[:2] == expected[:2]
        np.testing.assert_array_equal(frame.image, expected.image)


def test_video_is_decoded_in_order_with_time(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.mp4", 12)
    source = open_source(tmp_path / "clip.mp4")
    assert isinstance(source, VideoSource)
    assert source.expected_frames == 12
    frames = list(source)
    assert len(frames) == 12
    assert np.abs(np.array(reds(frames)) - 10 * np.arange(12)).max() < 5
    np.testing.assert_allclose([frame.timestamp for frame in frames], 0.1 * np.arange(12), atol=1e-6)
    assert not hasattr(source, "__len__")
    # Every iteration starts anew.
    assert len(list(source)) == 12


def test_video_stride_and_limit(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.mp4", 12)
    source = open_source(tmp_path / "clip.mp4", stride=5, max_frames=2)
    frames = list(source)
    assert [frame.name for frame in frames] == ["frame-000000", "frame-000005"]
    np.testing.assert_allclose(frames[1].timestamp, 0.5, atol=1e-6)
    assert source.expected_frames == 2


def test_real_video_opens_and_gives_frames(examples_dir: Path) -> None:
    frames = list(open_source(examples_dir / "video" / "handheld_box.mp4", max_frames=3))
    assert [frame.image.shape for frame in frames] == [(480, 640, 3)] * 3


@pytest.mark.slow
def test_real_video_is_counted_by_decoding(examples_dir: Path) -> None:
    source = open_source(examples_dir / "video" / "handheld_box.mp4")
    assert source.expected_frames == 456
    assert sum(1 for _ in source) == 455


def test_video_that_ends_early_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "clip.mp4", 12)
    source = VideoSource(tmp_path / "clip.mp4", SourceOptions())
    monkeypatch.setattr(source, "_announced", 40)
    with pytest.warns(UserWarning, match="12 frames decoded, its header announces 40"):
        assert len(list(source)) == 12


def test_what_is_no_video_and_wrong_options_are_named(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_text("not a video")
    with pytest.raises(ValueError, match=r"clip\.mp4 cannot be opened as a video"):
        open_source(tmp_path / "clip.mp4")
    with pytest.raises(ValueError, match="stride"):
        open_source(tmp_path, stride=0)
    with pytest.raises(ValueError, match="max_frames"):
        open_source(tmp_path, max_frames=0)
