"""Videos give upright, whole pictures with the file's own times, and what cannot be decoded is named."""

from __future__ import annotations

import gc
import http.server
import io
import itertools
import os
import re
import shlex
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import av.subtitles.stream  # which PyAV would import when the package is hidden already
import cv2
import numpy as np
import pytest
from PIL import Image

from logvggt_jax.errors import InputError, MissingInput
from logvggt_jax.reconstruction.sources import (
    SourceFrame,
    SourceOptions,
    VideoSource,
    media_info,
    open_source,
    opencv_decoder,
    opencv_messages,
    pyav_decoder,
    video,
)
from logvggt_jax.reconstruction.sources.pauses import Pauses
from logvggt_jax.reconstruction.sources.sampling import FrameClock, expected_frames
from logvggt_jax.reconstruction.sources.source import SkippedFrame
from logvggt_jax.reconstruction.sources.vp9_frames import FrameSizes

HEIGHT, WIDTH = 48, 64
COLOURS = np.array([[[230, 30, 30], [30, 200, 30]], [[30, 30, 230], [220, 220, 60]]], np.uint8)


@pytest.fixture(params=["pyav", "opencv"])
def library(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each library that may decode: OpenCV does where PyAV is not installed."""
    if request.param == "opencv":
        monkeypatch.setitem(sys.modules, "av", None)
    return request.param


@pytest.fixture
def opencv_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)


def quarters(height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """Red and green above blue and yellow."""
    return np.repeat(np.repeat(COLOURS, height // 2, 0), width // 2, 1)


def grey(index: int, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    return np.full((height, width, 3), 40 + 8 * index, np.uint8)


def busy(index: int) -> np.ndarray:
    """A picture that takes some bytes to encode."""
    noise = np.random.default_rng(index).integers(0, 256, (HEIGHT // 8, WIDTH // 8, 3), np.uint8)
    return np.repeat(np.repeat(noise, 8, 0), 8, 1)


def write(
    path: Path,
    images: Sequence[np.ndarray],
    *,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    rate: int = 10,
    stamps: Sequence[int] | None = None,
    options: dict[str, str] | None = None,
    turned: tuple[float, bool] | None = None,
    context: dict[str, Any] | None = None,
    source_pixels: dict[str, Any] | None = None,
    container_options: dict[str, str] | None = None,
) -> Path:
    """Encodes images; `stamps` are presentation times in units of 1 / rate, `turned` is (degrees, mirrored)."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=rate, options=options or {})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pixels
        for name, value in (context or {}).items():
            setattr(stream.codec_context, name, value)
        if turned is not None:
            stream.set_display_rotation(turned[0], hflip=turned[1])
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, "rgb24").reformat(format=pixels, **(source_pixels or {}))
            frame.pts, frame.time_base = index if stamps is None else stamps[index], Fraction(1, rate)
            for name in {"color_trc"} & (context or {}).keys():
                setattr(frame, name, context[name])
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def packets(path: Path) -> list[tuple[int, int, int]]:
    """(position in the file, size, presentation time) of the packets, as they are stored."""
    with av.open(str(path)) as container:
        return [(p.pos, p.size, p.pts) for p in container.demux(video=0) if p.size]


def damage(path: Path, numbers: Sequence[int]) -> Path:
    """Overwrites packets."""
    content = bytearray(path.read_bytes())
    for number in numbers:
        position, size, _ = packets(path)[number]
        content[position : position + size] = b"\xff" * size
    path.write_bytes(content)
    return path


def rewritten(
    path: Path,
    source: Path,
    change: Callable[[int, bytes], bytes | None] = lambda _, packet: packet,
    options: dict[str, str] | None = None,
) -> Path:
    """A copy with what `change` makes of the packets, by their number in the file; without those that it makes None."""
    with av.open(str(source)) as container, av.open(str(path), "w", options=options or {}) as output:
        stream = output.add_stream_from_template(container.streams.video[0])
        for number, packet in enumerate(packet for packet in container.demux(video=0) if packet.size):
            if (content := change(number, bytes(packet))) is not None:
                copy = av.Packet(content)
                copy.pts, copy.dts, copy.duration = packet.pts, packet.dts, packet.duration
                copy.time_base, copy.is_keyframe, copy.stream = packet.time_base, packet.is_keyframe, stream
                output.mux(copy)
    return path


def times(frames: Sequence[SourceFrame]) -> list[float]:
    return [frame.timestamp for frame in frames]


def names(frames: Iterable[SourceFrame]) -> list[int]:
    return [int(frame.name.removeprefix("frame-")) for frame in frames]


def corners(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return image[height // 4 :: height // 2, width // 4 :: width // 2].astype(int)


# ---- order, names, times -------------------------------------------------------------------------------------------


def test_frames_come_in_order_with_names_and_times(tmp_path: Path, library: str) -> None:
    # With B-frames, which are stored in another order than shown.
    path = write(tmp_path / "clip.mp4", [grey(i) for i in range(12)], options={"bf": "2"})
    source = open_source(path)
    assert isinstance(source, VideoSource)
    assert source.expected_frames == 12
    assert source.image_size == (HEIGHT, WIDTH)
    assert not hasattr(source, "__len__")
    frames = list(source)
    assert [frame.name for frame in frames] == [f"frame-{i:06d}" for i in range(12)]
    np.testing.assert_allclose(times(frames), np.arange(12) / 10, atol=1e-6)
    assert np.abs([frame.image.mean() - 40 - 8 * i for i, frame in enumerate(frames)]).max() < 4
    assert frames[0].image.dtype == np.uint8
    # Every iteration begins anew.
    assert len(list(source)) == 12


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "avi", "asf"])
def test_times_are_those_of_the_file(tmp_path: Path, library: str, suffix: str) -> None:
    stamps = [0, 1, 2, 3, 9, 13, 30, 31]
    # The last two state no times of presentation: without references in both directions those of decoding are the same.
    options = {"bf": "0"} if suffix in ("avi", "asf") else {}
    path = write(tmp_path / f"paused.{suffix}", [grey(i) for i in range(8)], stamps=stamps, options=options)
    frames = list(open_source(path))
    np.testing.assert_allclose(times(frames), np.array(stamps) / 10, atol=1e-3)
    np.testing.assert_allclose(times(list(open_source(path, stride=3))), np.array(stamps[::3]) / 10, atol=1e-3)


@pytest.mark.parametrize("suffix", ["mkv", "asf"])
def test_a_late_start_is_time_zero_and_no_early_end(tmp_path: Path, library: str, suffix: str) -> None:
    path = write(tmp_path / f"late.{suffix}", [grey(i) for i in range(12)], stamps=range(15, 27))
    source = open_source(path)
    np.testing.assert_allclose(times(list(source)), np.arange(12) / 10, atol=1e-3)
    if library == "pyav" and suffix == "mkv":
        assert source.expected_frames == 12


def test_gif_keeps_its_own_durations(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "a.gif", [grey(3 * i) for i in range(4)], codec="gif", pixels="rgb8", stamps=[0, 1, 5, 7])
    np.testing.assert_allclose(times(list(open_source(path))), [0, 0.1, 0.5, 0.7], atol=1e-3)


@pytest.mark.parametrize("rate", [10, 12])
@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("raw.h264", "libx264", "yuv420p"),
        ("raw.hevc", "libx265", "yuv420p"),
        ("raw.m2v", "mpeg2video", "yuv420p"),
        ("raw.mjpeg", "mjpeg", "yuvj420p"),
    ],
)
def test_a_stream_without_times_is_counted(
    tmp_path: Path, library: str, rate: int, name: str, codec: str, pixels: str
) -> None:
    options = {"bf": "2"} if codec == "mpeg2video" else {}
    images = [grey(i) for i in range(8)]
    path = write(tmp_path / name, images, codec=codec, pixels=pixels, rate=rate, options=options)
    if library == "opencv" and name in REFUSED_BY_OPENCV:
        refused(path)
        return
    source = open_source(path, strict=True)
    # The rate is the stream's own, where it states one; OpenCV does not tell it.
    if codec == "mjpeg" or (library == "opencv" and not media_info.media_info_is_there()):
        rate = 25
    frames = list(source)
    # MediaInfo takes 12 for what television calls 12, 11.988.
    np.testing.assert_allclose(times(frames), np.arange(8) / rate, rtol=1e-7 if library == "pyav" else 1.1e-3)
    np.testing.assert_allclose([frame.image.mean() for frame in frames], [image.mean() for image in images], atol=3)
    told = re.search(r"states no times: (\S+) frames a second are assumed", source.notes[0])
    assert told and float(told[1]) == pytest.approx(rate, rel=1.1e-3)


def test_time_stamps_in_the_order_of_storage_are_sorted(tmp_path: Path, library: str) -> None:
    """Some recorders number packets as they are stored, though frames with references in both directions are shown in
    another order: nothing is missing, and the k-th frame is shown at the k-th time."""
    images = [grey(i) for i in range(12)]
    honest = write(tmp_path / "honest.mp4", images, options={"bf": "2", "b-adapt": "0"}, stamps=range(0, 36, 3))
    path = tmp_path / "walk.mp4"
    with av.open(str(honest)) as source, av.open(str(path), "w") as container:
        stream = container.add_stream_from_template(source.streams.video[0])
        stored = [packet for packet in source.demux(video=0) if packet.size]
        stamps = [packet.pts for packet in stored]
        assert stamps != sorted(stamps), "frames are stored as they are shown"
        for packet, stamp in zip(stored, sorted(stamps), strict=True):
            packet.pts = packet.dts = stamp
            packet.stream = stream
            container.mux(packet)
    frames, truth = list(open_source(path, strict=True)), list(open_source(honest))
    assert names(frames) == list(range(12))
    np.testing.assert_allclose(times(frames), 0.3 * np.arange(12), atol=1e-6)
    for ours, theirs in zip(frames, truth, strict=True):
        np.testing.assert_array_equal(ours.image, theirs.image)


def test_windows_media_has_its_frames_in_order(tmp_path: Path, library: str) -> None:
    """Its packets have the times at which they are decoded, and no other."""
    images = [grey(i) for i in range(24)]
    path = write(tmp_path / "walk.wmv", images, options={"bf": "2", "b-adapt": "0"})
    frames = list(open_source(path, strict=True))
    np.testing.assert_allclose(times(frames), np.arange(24) / 10, atol=1e-3)
    np.testing.assert_allclose([frame.image.mean() for frame in frames], [image.mean() for image in images], atol=3)


def test_joined_recordings_go_on_in_time(tmp_path: Path, library: str) -> None:
    one = write(tmp_path / "one.ts", [grey(i) for i in range(8)])
    path = tmp_path / "joined.ts"
    path.write_bytes(one.read_bytes() * 2)
    np.testing.assert_allclose(times(list(open_source(path))), np.arange(16) / 10, atol=1e-4)


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        ([5.0, 5.1, 5.2], [0, 0.1, 0.2]),
        ([None, None, None], [0, 0.1, 0.2]),
        ([None, 7.0, 7.1], [0, 0.1, 0.2]),
        ([0, 0.1, None, 0.35], [0, 0.1, 0.2, 0.35]),
        # Twice the same, and a little out of order.
        ([0, 0.1, 0.1, 0.3], [0, 0.1, 0.15, 0.3]),
        ([0, 0.2, 0.1, 0.4], [0, 0.2, 0.25, 0.4]),
        # The clock begins anew; one wrong time stamp among right ones.
        ([9, 9.1, 9.2, 9.3, 9.4, 2, 2.1, 2.3], [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8]),
        ([9, 9.1, 9.2, 9.3, 9.4, 0, 9.6, 9.7], [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]),
    ],
)
def test_times_increase_whatever_the_file_says(stamps: list[float | None], expected: list[float]) -> None:
    clock = FrameClock(10.0)
    seconds = [clock.time(stamp) for stamp in stamps]
    np.testing.assert_allclose(seconds, expected, atol=1e-9)
    assert (np.diff(seconds) > 0).all()


# ---- which frames are taken ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "positions"),
    [
        ({"stride": 5, "max_frames": 2}, [0, 5]),
        ({"fps": 5}, range(0, 30, 2)),
        ({"fps": 100}, range(30)),
        ({"fps": 4}, [0, 3, 5, 8, 10, 13, 15, 18, 20, 23, 25, 28]),
        ({"start": 1.0}, range(10, 30)),
        ({"end": 0.5}, range(5)),
        ({"start": 0.35, "end": 1.2}, range(4, 12)),
        ({"start": 1.0, "end": 2.5, "fps": 2}, [10, 15, 20]),
        ({"stride": 3, "start": 1.0, "end": 2.0}, [12, 15, 18]),
        ({"stride": 2, "fps": 3, "max_frames": 4}, [0, 4, 8, 10]),
    ],
)
def test_frames_are_chosen_by_position_and_time(
    tmp_path: Path, library: str, options: dict[str, Any], positions: Sequence[int]
) -> None:
    source = open_source(write(tmp_path / "clip.mp4", [grey(0)] * 30), **options)
    frames = list(source)
    assert names(frames) == list(positions)
    np.testing.assert_allclose(times(frames), np.array(positions) / 10, atol=1e-6)
    assert source.expected_frames == len(frames)


def test_a_rate_is_held_where_the_distances_vary(tmp_path: Path, library: str) -> None:
    stamps = [0, 1, 2, 3, 4, 5, 20, 40, 41, 42, 43, 44, 60]
    path = write(tmp_path / "vfr.mkv", [grey(0)] * len(stamps), stamps=stamps, rate=30)
    seconds = np.array(times(list(open_source(path, fps=10))))
    np.testing.assert_allclose(seconds * 30, [0, 3, 20, 40, 42, 60], atol=0.05)


def test_expected_numbers() -> None:
    assert expected_frames(SourceOptions(), None, 30.0) is None
    assert expected_frames(SourceOptions(max_frames=7), None, None) == 7
    assert expected_frames(SourceOptions(stride=4), 10, None) == 3
    assert expected_frames(SourceOptions(start=100.0), 30, 10.0) == 0


@pytest.mark.parametrize("options", [{}, {"stride": 3}, {"fps": 3, "start": 0.4}])
def test_a_tail_is_the_same_as_that_of_all(tmp_path: Path, library: str, options: dict[str, Any]) -> None:
    path = write(tmp_path / "clip.mp4", [busy(i) for i in range(24)], options={"bf": "2", "g": "12"})
    path = damage(path, [16])
    source = open_source(path, **options)
    complete = list(source)
    skipped = list(source.skipped)
    for first in (0, 1, 3, len(complete)):
        tail = [load() for load in source.loaders(first)]
        assert len(tail) == len(complete) - first
        for frame, expected in zip(tail, complete[first:], strict=True):
            assert frame[:2] == expected[:2]
            np.testing.assert_array_equal(frame.image, expected.image)
        assert source.skipped == skipped


def test_another_library_gives_another_fingerprint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "clip.mp4", [grey(i) for i in range(4)])
    first = open_source(path).fingerprint(2)
    assert open_source(path, max_frames=3).fingerprint(2) == first
    assert open_source(path, stride=2).fingerprint(2) != first
    monkeypatch.setitem(sys.modules, "av", None)
    assert open_source(path).fingerprint(2) != first


def test_frames_that_are_done_with_are_gone_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And not when Python next looks for what refers to itself: of large pictures that is gigabytes later."""
    path = write(tmp_path / "walk.mp4", [busy(i) for i in range(24)], turned=(90, False))
    gc.collect()
    gc.disable()
    try:
        taken = sum(1 for _ in open_source(path))
        left = sum(isinstance(each, av.VideoFrame) for each in gc.get_objects())
    finally:
        gc.enable()
    assert taken == 24
    # One for the header and one for the pictures tell how they are turned.
    assert left <= 3


def test_a_tail_converts_nothing_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_source(write(tmp_path / "clip.mp4", [grey(i) for i in range(8)]))
    converted = []
    original = source._frame
    monkeypatch.setattr(source, "_frame", lambda name, *rest: converted.append(name) or original(name, *rest))
    assert [load().name for load in source.loaders(6)] == converted == ["frame-000006", "frame-000007"]


def test_no_frame_where_the_options_ask_for_it(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "clip.mp4", [grey(i) for i in range(8)])
    with pytest.raises(InputError, match=r"clip\.mp4 (lasts 0\.8 s, but start is 9 s|gave no frame between 9 s)"):
        list(open_source(path, start=9))


# ---- pictures ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_pictures_are_upright(tmp_path: Path, library: str, degrees: int, mirrored: bool, suffix: str) -> None:
    path = write(tmp_path / f"turned.{suffix}", [quarters()] * 2, turned=(degrees, mirrored))
    expected = np.rot90(quarters(), degrees // 90)
    if mirrored:
        expected = expected[:, ::-1]
    source = open_source(path)
    image = next(iter(source)).image
    assert source.image_size == image.shape[:2] == expected.shape[:2]
    np.testing.assert_allclose(corners(image), corners(expected), atol=12)


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_pictures_are_upright_by_a_tag(tmp_path: Path, library: str, degrees: int) -> None:
    path = write(tmp_path / "plain.mkv", [quarters()] * 2)
    tagged = tmp_path / "tagged.mkv"
    with av.open(str(path)) as container, av.open(str(tagged), "w") as output:
        stream = output.add_stream_from_template(container.streams.video[0])
        stream.metadata["rotate"] = str(degrees)
        for packet in container.demux(video=0):
            if packet.size:
                packet.stream = stream
                output.mux(packet)
    image = next(iter(open_source(tagged))).image
    np.testing.assert_allclose(corners(image), corners(np.rot90(quarters(), -degrees // 90)), atol=12)


def upright(orientation: int) -> np.ndarray:
    """What is shown of `quarters`, which a camera has noted to lie in this EXIF orientation."""
    image = quarters()[:, ::-1] if orientation in (2, 4, 5, 7) else quarters()
    return np.rot90(image, {1: 0, 2: 0, 3: 2, 4: 2, 5: 1, 6: -1, 7: -1, 8: 1}[orientation])


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_as_a_video_keep_what_their_camera_noted(tmp_path: Path, orientation: int, library: str) -> None:
    def photo(number: int, packet: bytes) -> bytes:
        exif, picture = Image.Exif(), io.BytesIO()
        exif[0x0112] = orientation if number else 1
        Image.open(io.BytesIO(packet)).save(picture, "JPEG", quality=95, exif=exif)
        return picture.getvalue()

    plain = write(tmp_path / "plain.avi", [quarters()] * 4, codec="mjpeg", pixels="yuvj420p")
    # The whole of it, and one of which the first photo lies otherwise.
    source = open_source(rewritten(tmp_path / "photos.avi", plain, lambda _, packet: photo(1, packet)))
    image = next(iter(source)).image
    assert source.image_size == image.shape[:2] == upright(orientation).shape[:2]
    np.testing.assert_allclose(corners(image), corners(upright(orientation)), atol=16)
    mixed = open_source(rewritten(tmp_path / "mixed.avi", plain, photo))
    if orientation < 5:
        _, *images = (frame.image for frame in mixed)
        np.testing.assert_allclose(corners(images[-1]), corners(upright(orientation)), atol=16)
    else:
        with pytest.raises(InputError, match="frame 1 is 48 x 64 pixels but the video begins with 64 x 48"):
            list(mixed)


def test_damaged_camera_data_leave_a_video_alone(tmp_path: Path, library: str) -> None:
    plain = write(tmp_path / "plain.avi", [quarters()] * 2, codec="mjpeg", pixels="yuvj420p")
    odd = b"\xff\xd8\xff\xe1\x00\x14Exif\0\0MM\0*\xff\xff\xff\xff\0\0\0\0"
    path = rewritten(tmp_path / "odd.avi", plain, lambda _, packet: odd + packet[2:])
    np.testing.assert_allclose(corners(next(iter(open_source(path))).image), corners(quarters()), atol=16)


def interlaced(count: int) -> list[np.ndarray]:
    """A bright bar that moves from field to field."""
    images = []
    for index in range(count):
        image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
        for field in (0, 1):
            left = 4 * (2 * index + field)
            image[field::2, left : left + 16] = 200
        images.append(image)
    return images


def combing(image: np.ndarray) -> float:
    """How much neighbouring lines differ beyond those two apart."""
    lines = image[..., 1].astype(float)
    return float(np.abs(lines[1:-1] - (lines[:-2] + lines[2:]) / 2).mean() - np.abs(lines[:-2] - lines[2:]).mean() / 2)


INTERLACED: dict[str, dict[str, Any]] = {
    "h264.mp4": {"codec": "libx264", "options": {"flags": "+ildct+ilme", "x264-params": "tff=1"}},
    "mpeg2.ts": {"codec": "mpeg2video", "options": {"flags": "+ildct+ilme", "b": "2000k"}},
    "prores.mov": {"codec": "prores_ks", "pixels": "yuv422p10le", "options": {"flags": "+ildct"}},
    "raw.mov": {"codec": "rawvideo", "pixels": "uyvy422"},
    # Only their headers tell.
    "mjpeg.mkv": {"codec": "mjpeg", "pixels": "yuvj422p"},
    "png.mov": {"codec": "png", "pixels": "rgb24"},
}


@pytest.mark.parametrize("name", INTERLACED)
def test_interlaced_pictures_are_made_whole(tmp_path: Path, name: str) -> None:
    images = interlaced(6)
    path = write(tmp_path / name, images, context={"field_order": 2}, **INTERLACED[name])
    source = open_source(path)
    assert any("deinterlaced" in note for note in source.notes)
    frames = list(source)
    np.testing.assert_allclose(times(frames), np.arange(6) / 10, atol=1e-3)
    for frame, image in zip(frames, images, strict=True):
        assert combing(image) > 10
        assert combing(frame.image) < 0.3 * combing(image)
        # It is the picture: the bar of the first or second field on the background.
        np.testing.assert_allclose(frame.image.mean(), image.mean(), atol=6)
    tail = [load() for load in source.loaders(4)]
    np.testing.assert_array_equal(tail[0].image, frames[4].image)


def test_another_release_of_pyav_leaves_videos_to_opencv_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "walk.mp4", [grey(i) for i in range(3)])
    monkeypatch.setattr(av, "__version__", "20.1.0")
    with pytest.warns(UserWarning, match=r"PyAV 20\.1\.0 .* OpenCV reads .*walk\.mp4 .*logvggt-jax\[video\]"):
        source = open_source(path)
    assert len(list(source)) == 3


def test_frames_that_stay_the_same_are_taken_by_opencv(tmp_path: Path, opencv_only: None) -> None:
    path = write(tmp_path / "still.avi", [grey(0)] * 5, codec="huffyuv", pixels="yuv422p")
    assert len(list(open_source(path))) == 5


def test_tags_that_are_no_unicode(tmp_path: Path, library: str) -> None:
    """As cameras and old programs write them in the encoding of their country."""
    path = write(tmp_path / "clip.mkv", [grey(i) for i in range(3)])
    path.write_bytes(path.read_bytes().replace(b"Lavf", b"L\xe4v\xff"))
    assert len(list(open_source(path))) == 3


def test_a_damaged_duration_is_no_duration(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "clip.mkv", [grey(i) for i in range(5)])
    path.write_bytes(path.read_bytes().replace(b"00:00:00.5", b"00:0?:0x.5"))
    assert len(list(open_source(path))) == 5


@pytest.mark.parametrize("name", INTERLACED)
def test_opencv_refuses_interlaced_pictures(tmp_path: Path, opencv_only: None, name: str) -> None:
    path = write(tmp_path / f"tv-{name}", interlaced(4), context={"field_order": 2}, **INTERLACED[name])
    with pytest.raises(InputError, match=r"/tv-\S+ is interlaced.*logvggt-jax\[video\].*ffmpeg -i"):
        open_source(path)


def test_an_interlaced_part_after_progressive_frames(tmp_path: Path, library: str) -> None:
    one = write(tmp_path / "one.ts", [grey(i) for i in range(4)], options={"g": "4"})
    two = write(
        tmp_path / "two.ts", interlaced(4), context={"field_order": 2}, **INTERLACED["h264.mp4"], stamps=range(4, 8)
    )
    path = tmp_path / "both.ts"
    path.write_bytes(one.read_bytes() + two.read_bytes())
    source = open_source(path)
    if library == "opencv":
        with pytest.raises(InputError, match=r"both\.ts is interlaced"):
            list(source)
        return
    frames = list(source)
    assert len(frames) == 8
    assert max(combing(frame.image) for frame in frames) < 0.3 * combing(interlaced(4)[1])


@pytest.mark.parametrize("stride", [1, 3])
def test_a_change_of_size_is_noticed(tmp_path: Path, library: str, stride: int) -> None:
    one = write(tmp_path / "one.ts", [grey(i) for i in range(6)])
    two = write(tmp_path / "two.ts", [grey(i, WIDTH, HEIGHT) for i in range(6)], stamps=range(6, 12))
    path = tmp_path / "both.ts"
    path.write_bytes(one.read_bytes() + two.read_bytes())
    frames = iter(open_source(path, stride=stride))
    for _ in range(0, 6, stride):
        next(frames)
    with pytest.raises(InputError, match=r"both\.ts: frame 6 is 48 x 64 pixels but the video begins with 64 x 48"):
        next(frames)
    assert len(list(open_source(path, end=0.55))) == 6


@pytest.mark.parametrize(("height", "width", "scaled"), [(2 * HEIGHT, 2 * WIDTH, True), (WIDTH, HEIGHT, False)])
def test_scaling_is_advised_where_it_squashes_nothing(
    tmp_path: Path, library: str, height: int, width: int, scaled: bool
) -> None:
    one = write(tmp_path / "one.ts", [grey(i) for i in range(6)])
    two = write(tmp_path / "two.ts", [grey(i, height, width) for i in range(6)], stamps=range(6, 12))
    path = tmp_path / "both.ts"
    path.write_bytes(one.read_bytes() + two.read_bytes())
    with pytest.raises(InputError, match="all frames need one size; cut it there") as caught:
        list(open_source(path))
    assert ("scale=64:48" in str(caught.value)) == scaled


# What OpenCV alone does not read: its format or codec does not tell it all that PyAV is told.
REFUSED_BY_OPENCV = (
    *("raw.m2v", "bare.m2v", "mpeg2.mpg", "mpeg2.mxf", "h264.nut", "vp9.ivf", "raw.y4m", "raw10.y4m"),
    *("vp8.webm", "vp8.ivf"),
)


def refused(path: Path) -> None:
    """Asserts that a file is refused before anything is decoded, with what mends it."""
    with pytest.raises(InputError, match=r"does not notice all damage.*: pip install .*\[video\].*re-encode") as caught:
        open_source(path)
    assert str(caught.value).startswith(f"{path} is of a ")


def joined(path: Path, parts: Sequence[Path]) -> Path:
    """One file of the packets of several, one after the other in time."""
    with av.open(str(path), "w") as output:
        stream, offset = None, Fraction(0)
        for part in parts:
            with av.open(str(part)) as container:
                source = container.streams.video[0]
                stream = stream or output.add_stream_from_template(source)
                end = offset
                for packet in container.demux(source):
                    if packet.size:
                        shift = round(offset / packet.time_base)
                        end = max(end, offset + (packet.pts + 1) * packet.time_base + Fraction(1, 20))
                        packet.pts, packet.dts, packet.stream = packet.pts + shift, packet.dts + shift, stream
                        output.mux(packet)
                offset = end
    return path


@pytest.mark.parametrize(
    ("suffix", "codec", "options", "frame"),
    [
        ("ts", "libx264", {"bf": "2"}, 4),
        ("avi", "libx264", {"bf": "2"}, 4),
        ("ts", "libx265", {"x265-params": "log-level=none:frame-threads=1:bframes=0"}, 4),
        ("webm", "libvpx", {}, 4),
        ("webm", "libvpx-vp9", {}, 4),
        ("avi", "mjpeg", {}, 4),
        ("flv", "flv", {}, 4),
        ("mov", "h263", {}, 4),
        ("mov", "png", {}, 4),
        ("mov", "dnxhd", {"profile": "dnxhr_sq"}, 4),
        # FFmpeg's decoders of MPEG lose the last frame before the change, which is named where times tell it.
        ("ts", "mpeg2video", {}, 4),
        ("ts", "mpeg4", {}, 4),
        ("avi", "mpeg2video", {"bf": "2"}, 3),
        ("avi", "mpeg4", {"bf": "2"}, 3),
    ],
)
def test_a_change_of_size_is_noticed_in_every_usual_codec(
    tmp_path: Path, library: str, suffix: str, codec: str, options: dict[str, str], frame: int
) -> None:
    """As browsers record a call, cameras a night, and joined streams."""
    pixels = {"mjpeg": "yuvj420p", "png": "rgb24", "dnxhd": "yuv422p"}.get(codec, "yuv420p")
    how = {"codec": codec, "options": options, "pixels": pixels}
    if codec == "libvpx" and library == "opencv":
        refused(write(tmp_path / f"call.{suffix}", [grey(n) for n in range(4)], **how))
        return
    sizes = [(288, 352), (160, 288) if codec == "dnxhd" else (144, 176)]
    parts = [write(tmp_path / f"{size[0]}.{suffix}", [grey(n, *size) for n in range(4)], **how) for size in sizes]
    source = open_source(joined(tmp_path / f"call.{suffix}", parts), most_broken=1.0)
    frames = []
    with pytest.raises(InputError, match=rf"frame {frame} is \d+ x 1\d\d pixels but the video begins with 352 x 288"):
        frames += source
    assert {image.image.shape for image in frames} == {(288, 352, 3)}
    assert names(frames) == list(range(frame - len(source.skipped)))


def bits(*numbers: tuple[int, int]) -> bytes:
    """Numbers of so many bits each."""
    text = "".join(f"{number:0{count}b}" for number, count in numbers)
    return int(text.ljust(192, "0"), 2).to_bytes(24, "big")


def test_frames_of_vp9_may_change_the_size_without_a_key_frame() -> None:
    """As browsers do in a call; no encoder here does so on request."""
    begin, key, inter = (2, 2), (0b00_0_0_1_0, 6), (0b00_0_1_1_0, 6)
    stated = (175, 16), (143, 16)
    sizes = FrameSizes()
    assert sizes.follow(bits(begin, key, (0x498342, 24), (0b001_0, 4), (351, 16), (287, 16))) == (True, (288, 352))
    # It is not kept, refers to three frames, and takes over the size of the first, or none's.
    assert sizes.follow(bits(begin, inter, (0, 2), (0, 8), (0, 12), (1, 1))) == (True, (288, 352))
    # It is kept in the second place.
    assert sizes.follow(bits(begin, inter, (0, 2), (0b10, 8), (0, 12), (0, 3), *stated)) == (True, (144, 176))
    assert sizes.follow(bits(begin, inter, (0, 2), (0, 8), (0b000_0_001_0_000_0, 12), (0b01, 2))) == (True, (144, 176))
    assert sizes.follow(bits(begin, inter, (0, 2), (0, 8), (0b000_0_001_0_000_0, 12), (1, 1))) == (True, (288, 352))
    assert sizes.follow(bits(begin, (0b00_1, 3), (1, 3))) == (True, (144, 176))  # shown again
    assert sizes.follow(bits(begin, (0b00_0_1_0_0, 6), (0, 1), (0, 2), (0, 8), (0, 12), (1, 1))) == (False, None)
    assert sizes.follow(b"\xff" * 24) == (True, None)  # damaged


@pytest.mark.parametrize("options", [{"lag-in-frames": "16", "auto-alt-ref": "1"}, {"error-resilient": "1"}, {}])
def test_packets_of_vp9_show_a_frame_each_of_one_size(tmp_path: Path, options: dict[str, str]) -> None:
    path = write(tmp_path / "walk.webm", [busy(i // 4) for i in range(40)], codec="libvpx-vp9", options=options)
    sizes = FrameSizes()
    with av.open(str(path)) as container:
        stored = [sizes.follow(bytes(packet)) for packet in container.demux(video=0) if packet.size]
    assert stored == [(True, (HEIGHT, WIDTH))] * 40


CODECS: dict[str, dict[str, Any]] = {
    "h264": {},
    "hevc": {"codec": "libx265", "options": {"x265-params": "log-level=none:frame-threads=1:bframes=0"}},
    "mpeg2video": {"codec": "mpeg2video"},
}


@pytest.mark.parametrize(("before", "after"), list(itertools.permutations(CODECS, 2)))
def test_a_change_of_codec_is_named(tmp_path: Path, library: str, before: str, after: str) -> None:
    path = tmp_path / "both.ts"
    parts = [
        write(tmp_path / f"{name}.ts", [busy(i) for i in range(24)], rate=25, **CODECS[name])
        for name in (before, after)
    ]
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    source = open_source(path)
    frames = []
    with pytest.raises(
        InputError, match=rf"both\.ts changes its codec about frame 2[1-4], from {before} to {after}: .*; cut it there"
    ):
        frames += source
    assert len(frames) >= 21 and len(source.skipped) <= 1
    assert len(list(open_source(path, end=0.5))) == 13


def test_a_change_of_pixel_format_is_converted(tmp_path: Path, library: str) -> None:
    one = write(tmp_path / "one.ts", [quarters()] * 4)
    two = write(tmp_path / "two.ts", [quarters()] * 4, pixels="yuv444p", stamps=range(4, 8))
    path = tmp_path / "both.ts"
    path.write_bytes(one.read_bytes() + two.read_bytes())
    frames = list(open_source(path))
    assert len(frames) == 8
    for frame in frames:
        np.testing.assert_allclose(corners(frame.image), corners(quarters()), atol=12)


COLOUR_FORMATS: dict[str, dict[str, Any]] = {
    "bt601.mp4": {},
    "full.mp4": {"pixels": "yuvj420p", "source_pixels": {"dst_color_range": 2}, "context": {"color_range": 2}},
    "bt709.mp4": {"source_pixels": {"dst_colorspace": 1}, "context": {"colorspace": 1}},
    "bt709full.mp4": {
        "source_pixels": {"dst_colorspace": 1, "dst_color_range": 2},
        "context": {"colorspace": 1, "color_range": 2},
    },
    "10bit.mp4": {"pixels": "yuv420p10le"},
    "16bit.mkv": {"codec": "ffv1", "pixels": "yuv444p16le"},
    "rgba.mkv": {"codec": "ffv1", "pixels": "bgra"},
    "hevc10.mkv": {
        "codec": "libx265",
        "pixels": "yuv420p10le",
        "options": {"x265-params": "log-level=none:frame-threads=1:bframes=0"},
    },
    "vp9.webm": {"codec": "libvpx-vp9"},
    "mjpeg.avi": {"codec": "mjpeg", "pixels": "yuvj420p", "source_pixels": {"dst_color_range": 2}},
    "mpeg4.avi": {"codec": "mpeg4"},
}


@pytest.mark.parametrize("name", COLOUR_FORMATS)
def test_colours_are_right(tmp_path: Path, library: str, name: str) -> None:
    image = next(iter(open_source(write(tmp_path / name, [quarters()] * 2, **COLOUR_FORMATS[name])))).image
    np.testing.assert_allclose(corners(image), corners(quarters()), atol=12)


class Unconverted:
    """OpenCV's capture, whose pictures are black: it takes seconds to convert the first one of HDR."""

    def __init__(self, capture: cv2.VideoCapture) -> None:
        self._capture = capture

    def __getattr__(self, name: str) -> Any:
        return getattr(self._capture, name)

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.zeros((HEIGHT, WIDTH, 3), np.uint8)


@pytest.mark.parametrize(("transfer", "called"), [(16, "PQ"), (18, "HLG")])
def test_hdr_is_told(tmp_path: Path, library: str, monkeypatch: pytest.MonkeyPatch, transfer: int, called: str) -> None:
    path = write(
        tmp_path / "hdr.mkv",
        [quarters()] * 2,
        codec="libx265",
        pixels="yuv420p10le",
        options={"x265-params": "log-level=none:frame-threads=1:bframes=0"},
        context={"colorspace": 9, "color_trc": transfer, "color_primaries": 9},
        source_pixels={"dst_colorspace": 9},
    )
    opened = opencv_decoder.OpenCVDecoder._open
    monkeypatch.setattr(opencv_decoder.OpenCVDecoder, "_open", lambda decoder: Unconverted(opened(decoder)))
    source = open_source(path)
    assert [note for note in source.notes if f"HDR ({called})" in note and "8 bits" in note]
    if library == "pyav":
        np.testing.assert_allclose(corners(next(iter(source)).image), corners(quarters()), atol=12)


def test_a_view_all_around_is_told(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "around.mp4", [grey(0)] * 2)
    content = bytearray(path.read_bytes())
    # As cameras and stitching programs note it: a box of its own at the end of the track's.
    noted = (
        b'<rdf:SphericalVideo xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">'
        b"<GSpherical:Spherical>true</GSpherical:Spherical><GSpherical:Stitched>true</GSpherical:Stitched>"
        b"<GSpherical:StitchingSoftware>x</GSpherical:StitchingSoftware>"
        b"<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType></rdf:SphericalVideo>"
    )
    box = (24 + len(noted)).to_bytes(4, "big") + b"uuid" + bytes.fromhex("ffcc8263f8554a938814587a02521fdd") + noted
    starts = [content.index(name) - 4 for name in (b"moov", b"trak")]
    assert content.index(b"mdat") < starts[0]
    sizes = [int.from_bytes(content[start : start + 4], "big") for start in starts]
    content[starts[1] + sizes[1] : starts[1] + sizes[1]] = box
    for start, size in zip(starts, sizes, strict=True):
        content[start : start + 4] = (size + len(box)).to_bytes(4, "big")
    path.write_bytes(content)
    (note,) = open_source(path).notes
    assert "looks all around (equirectangular)" in note and "v360" in note


def test_a_view_all_around_of_matroska_is_told(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "around.mkv", [quarters()] * 2, turned=(90, False))
    content = path.read_bytes()
    turned = b"\x76\x70\x8b\x76\x75\x88" + np.array(90, ">f8").tobytes()
    assert content.count(turned) == 1
    # The projection's type, and what is left of the turn's eleven bytes void.
    path.write_bytes(content.replace(turned, turned[:3] + b"\x76\x71\x81\x01\xec\x85" + bytes(5)))
    source = open_source(path)
    assert [note for note in source.notes if "looks all around (equirectangular)" in note]
    np.testing.assert_allclose(corners(next(iter(source)).image), corners(quarters()), atol=12)


def test_pixels_that_are_not_square_are_told(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "wide.mp4", [grey(0)] * 2, context={"sample_aspect_ratio": Fraction(4, 3)})
    assert any("not square (4:3)" in note for note in open_source(path).notes)


def test_loaders_may_be_called_in_any_order(tmp_path: Path, library: str) -> None:
    source = open_source(write(tmp_path / "clip.mp4", [busy(i) for i in range(6)]))
    loaders = list(source.loaders())
    loaded = [load() for load in reversed(loaders)][::-1]
    for frame, expected in zip(loaded, source, strict=True):
        assert frame[:2] == expected[:2]
        np.testing.assert_array_equal(frame.image, expected.image)


# ---- damage --------------------------------------------------------------------------------------------------------


def damaged(path: Path, numbers: Sequence[int], count: int = 24) -> tuple[Path, list[str]]:
    """A video in which the packets of these numbers are overwritten, and the names of their frames."""
    write(path, [busy(i) for i in range(count)], options={"bf": "2", "g": "12", "refs": "1"})
    stamps = [stamp for _, _, stamp in packets(path)]
    broken = sorted(sorted(stamps).index(stamps[number]) for number in numbers)
    return damage(path, numbers), [f"frame-{position:06d}" for position in broken]


def test_damaged_packets_are_skipped_and_named(tmp_path: Path, library: str) -> None:
    path, broken = damaged(tmp_path / "noise.mp4", [7, 15])
    source = open_source(path)
    frames = list(source)
    assert [frame.name for frame in source.skipped] == broken
    assert all(frame.reason for frame in source.skipped)
    assert sorted([*broken, *(frame.name for frame in frames)]) == [f"frame-{i:06d}" for i in range(24)]
    np.testing.assert_allclose(times(frames), np.array(names(frames)) / 10, atol=1e-6)


def test_frames_that_may_lack_what_a_damaged_one_showed_are_counted(tmp_path: Path) -> None:
    path, (broken,) = damaged(tmp_path / "noise.mp4", [7])
    source = open_source(path)
    assert len(list(source)) == 23
    with av.open(str(path)) as container:
        shown = sorted((packet.pts, packet.is_keyframe) for packet in container.demux(video=0) if packet.size)
    after = [is_key for _, is_key in shown[int(broken.removeprefix("frame-")) + 1 :]]
    assert source.notes[-1].endswith(f"next key frame, which may lack what it showed: {after.index(True)}")


@pytest.mark.parametrize("suffix", ["mp4", "ts"])
@pytest.mark.parametrize(
    "parameters",
    [
        "bframes=0",
        "bframes=2:b-adapt=0",
        "bframes=3:b-adapt=0:b-pyramid=normal",
        "keyint=12:open-gop=1:bframes=2:b-adapt=0",
        "keyint=12:intra-refresh=1",
        "slices=4",
    ],
)
def test_frames_that_a_copy_lost_are_told_where_others_refer_to_them(
    tmp_path: Path, library: str, suffix: str, parameters: str
) -> None:
    images = [busy(i) for i in range(40)]
    path = write(tmp_path / f"whole.{suffix}", images, options={"x264-params": f"scenecut=0:{parameters}"})
    whole = open_source(path)
    expected = {round(frame.timestamp, 2): frame.image for frame in whole}
    assert len(expected) == 40 and whole.notes == []
    lost = 13  # a frame to which others refer, in each of these
    source = open_source(rewritten(tmp_path / f"gap.{suffix}", path, lambda n, packet: None if n == lost else packet))
    frames = list(source)
    wrong = [
        number
        for number, frame in enumerate(frames)
        if np.abs(expected[round(frame.timestamp, 2)].astype(int) - frame.image).mean() > 1
    ]
    told, counted = source.notes
    assert len(frames) == 39 and wrong and source.skipped == []
    assert f"lacks frames before frame-{wrong[0]:06d}" in told and "to which later ones refer" in told
    assert "is missing and the next key frame, which may lack what it showed" in counted
    assert "intra-refresh" in parameters or int(counted.rsplit(" ", 1)[1]) >= len(wrong)


@pytest.mark.parametrize("codec", ["mpeg1video", "mpeg2video"])
@pytest.mark.parametrize(
    ("between", "lost"), [("0", [13]), ("0", [13, 14]), ("2", [10]), ("2", [16]), ("2", [16, 17, 18]), ("2", [25])]
)
def test_frames_of_mpeg_that_a_copy_lost_are_told(
    tmp_path: Path, library: str, codec: str, between: str, lost: list[int]
) -> None:
    """In the order of decoding I P B B P B B … and, every 24 frames, a key frame."""
    images = [np.roll(busy(0), 2 * i, 1) for i in range(48)]
    path = write(tmp_path / "a.mkv", images, codec=codec, rate=25, options={"g": "24", "bf": between})
    whole = open_source(path)
    truth = {round(frame.timestamp, 2): frame.image for frame in whole}
    assert len(truth) == 48 and not whole.notes
    source = open_source(rewritten(tmp_path / "b.mkv", path, lambda n, packet: None if n in lost else packet))
    frames = list(source)
    wrong = [
        frame.name
        for frame in frames
        if np.abs(truth.get(round(frame.timestamp, 2), frame.image).astype(int) - frame.image).mean() > 1
    ]
    assert wrong and any("may lack what it showed" in note for note in source.notes)


@pytest.mark.parametrize("lost", [[5], [6], [5, 6], [8, 12]])
def test_frames_of_mpeg_to_which_no_other_refers_are_lost_without_harm(
    tmp_path: Path, library: str, lost: list[int]
) -> None:
    path = write(tmp_path / "a.mkv", [busy(i) for i in range(24)], codec="mpeg2video", options={"g": "12", "bf": "2"})
    source = open_source(rewritten(tmp_path / "b.mkv", path, lambda n, packet: None if n in lost else packet))
    assert len(list(source)) == 24 - len(lost) and not source.notes and not source.skipped


def test_frames_to_which_no_other_refers_are_lost_without_harm(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "a.mp4", [busy(i) for i in range(20)], options={"bf": "2", "b-adapt": "0"})
    # The second of the two that lie between frames which others refer to.
    source = open_source(rewritten(tmp_path / "b.mp4", path, lambda n, packet: None if n == 6 else packet))
    assert len(list(source)) == 19 and not [note for note in source.notes if "lacks frames" in note]


def test_damage_to_a_stream_without_times_is_named_where_it_is(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "raw.h264", [busy(i) for i in range(12)], options={"bf": "0", "x264-params": "threads=1"})
    content = bytearray(path.read_bytes())
    position, size, stamp = packets(path)[5]
    assert stamp is None
    # The start code, by which packets are told apart, stays.
    content[position + 5 : position + size] = b"\xff" * (size - 5)
    path.write_bytes(content)
    source = open_source(path)
    assert names(list(source)) == [0, 1, 2, 3, 4, *range(6, 12)]
    assert [frame.name for frame in source.skipped] == ["frame-000005"]


@pytest.mark.parametrize("numbers", [[7, 15], [21], [22, 23]])
def test_damage_to_large_videos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, numbers: list[int]) -> None:
    # Decoded by several threads, which the library stops early if one of the last packets is damaged.
    monkeypatch.setattr(pyav_decoder, "_LARGE", 0)
    path, _ = damaged(tmp_path / "noise.mp4", numbers)
    source = open_source(path, most_broken=1.0)
    frames = list(source)
    assert len(frames) + len(source.skipped) == 24
    assert len(source.skipped) >= len(numbers)
    np.testing.assert_allclose(times(frames), np.array(names(frames)) / 10, atol=1e-6)


@pytest.mark.parametrize("number", [0, 3])
def test_a_packet_that_gives_neither_picture_nor_error_is_named(tmp_path: Path, library: str, number: int) -> None:
    path = write(tmp_path / "walk.mp4", [busy(i) for i in range(8)], codec="mpeg4")
    content = bytearray(path.read_bytes())
    position, size, _ = packets(path)[number]
    picture = content.index(b"\0\0\1\xb6", position, position + size)
    # The head of a picture that is "not coded", after the start code.
    content[picture + 4 : picture + 12] = bytes.fromhex("000000000000f07f")
    path.write_bytes(content)
    source = open_source(path, most_broken=1.0)
    shown = names(list(source))
    left_out = [int(frame.name.removeprefix("frame-")) for frame in source.skipped]
    assert number in left_out and shown[-1] == 7 and sorted([*shown, *left_out]) == list(range(8))
    assert {frame.reason for frame in source.skipped} == {"gives no picture"}


@pytest.mark.parametrize("codec", ["mpeg1video", "mpeg2video"])
@pytest.mark.parametrize("number", [5, 8, 11])
def test_a_picture_of_mpeg_that_vanishes_is_named(tmp_path: Path, library: str, codec: str, number: int) -> None:
    """Its decoder passes over a packet in which it finds no picture, be it of a key frame or the last one."""
    whole = write(tmp_path / "whole.mkv", [busy(i) for i in range(12)], codec=codec, rate=25, options={"g": "8"})
    noise = np.random.default_rng(0)
    path = rewritten(
        tmp_path / "walk.mkv", whole, lambda at, packet: noise.bytes(len(packet)) if at == number else packet
    )
    source = open_source(path)
    frames, truth = list(source), list(open_source(whole))
    assert names(frames) == [i for i in range(12) if i != number]
    assert [frame.name for frame in source.skipped] == [f"frame-{number:06d}"]
    np.testing.assert_array_equal(frames[0].image, truth[0].image)


@pytest.mark.parametrize("name", ["whole.mp4", "whole.mkv", "whole.webm"])
def test_a_picture_of_av1_that_vanishes_is_named(tmp_path: Path, name: str) -> None:
    """Each packet shows one frame, however many it holds; of what is noise its decoder says nothing."""
    whole = write(tmp_path / name, [busy(i) for i in range(24)], codec="libsvtav1", options={"preset": "10", "g": "12"})
    source = open_source(whole)
    assert names(list(source)) == list(range(24)) and not source.skipped and not source.notes
    content = bytearray(whole.read_bytes())
    with av.open(str(whole)) as container:
        stored = [bytes(packet) for packet in container.demux(video=0)]
    number = max(range(6, 12), key=lambda at: len(stored[at]))
    place = content.index(stored[number])
    # Units of a reserved kind, which are to be passed over.
    content[place : place + len(stored[number])] = (b"\x7a\x01\x00" * len(stored[number]))[: len(stored[number])]
    whole.write_bytes(content)
    source = open_source(whole, most_broken=1.0)
    assert number not in names(list(source))
    assert source.skipped[0] == SkippedFrame(f"frame-{number:06d}", "gives no picture")


@pytest.mark.parametrize("slices", [1, 2])
def test_damage_within_a_picture_of_h264_is_counted(tmp_path: Path, library: str, slices: int) -> None:
    images = [busy(i).repeat(2, 0).repeat(2, 1) for i in range(8)]
    path = write(tmp_path / "walk.mp4", images, options={"bf": "0", "x264-params": f"slices={slices}"})
    content = bytearray(path.read_bytes())
    position, size, _ = packets(path)[5]
    content[position + size // 4] ^= 255
    path.write_bytes(content)
    source = open_source(path)
    assert names(list(source)) == list(range(8))
    assert source.notes == [f"{path}: frames with damaged parts, which the decoder filled by guesses: 1"]


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [
        *((f"whole.{suffix}", "mpeg2video", {"bf": "2", "g": "8"}) for suffix in ("mkv", "mp4", "ts", "mpg", "avi")),
        *((f"whole.{suffix}", "mpeg1video", {"bf": "2", "g": "8"}) for suffix in ("mkv", "mp4", "ts", "mpg", "avi")),
        ("open.ts", "mpeg2video", {"bf": "2", "g": "6", "flags": "-cgop"}),
        ("delay.mpg", "mpeg2video", {"g": "6", "flags": "+low_delay"}),
    ],
)
def test_whole_videos_of_mpeg_miss_nothing(
    tmp_path: Path, library: str, name: str, codec: str, options: dict[str, str]
) -> None:
    path = write(tmp_path / name, [busy(i) for i in range(24)], codec=codec, rate=25, options=options)
    if library == "opencv" and path.suffix == ".mpg":
        refused(path)
        return
    source = open_source(path)
    assert names(list(source)) == list(range(24)) and not source.skipped and not source.notes


@pytest.mark.parametrize("number", [0, 3])
def test_a_jpeg_that_ends_too_soon_is_no_picture(tmp_path: Path, library: str, number: int) -> None:
    whole = write(tmp_path / "whole.avi", [busy(i) for i in range(6)], codec="mjpeg", pixels="yuvj420p")
    path = rewritten(
        tmp_path / "walk.avi", whole, lambda at, packet: packet[: len(packet) * 2 // 3] if at == number else packet
    )
    source = open_source(path)
    assert names(list(source)) == [i for i in range(6) if i != number]
    assert [frame.name for frame in source.skipped] == [f"frame-{number:06d}"]


@pytest.mark.parametrize("name", ["walk.avi", "walk.mjpeg"])
@pytest.mark.parametrize("mark", [b"\xff\xc0", b"\xff\xda"], ids=["frame", "scan"])
@pytest.mark.parametrize("number", [0, 3])
def test_a_jpeg_without_its_header_is_not_the_picture_before(
    tmp_path: Path, library: str, mark: bytes, number: int, name: str
) -> None:
    whole = write(tmp_path / f"whole.{name}", [busy(i) for i in range(6)], codec="mjpeg", pixels="yuvj420p")
    path = rewritten(
        tmp_path / name,
        whole,
        lambda at, packet: packet.replace(mark, b"\xff\xe9", 1) if at == number else packet,
    )
    source = open_source(path, most_broken=0.2)
    assert names(list(source)) == [i for i in range(6) if i != number]
    assert [frame.name for frame in source.skipped] == [f"frame-{number:06d}"]


def test_a_jpeg_without_its_end_mark_is_a_picture(tmp_path: Path, library: str) -> None:
    """As some cameras write them."""
    whole = write(tmp_path / "whole.avi", [busy(i) for i in range(6)], codec="mjpeg", pixels="yuvj420p")
    path = rewritten(tmp_path / "walk.avi", whole, lambda _, packet: packet[: packet.rindex(b"\xff\xd9")])
    source = open_source(path)
    assert names(list(source)) == list(range(6)) and not source.skipped and not source.notes


def test_long_damage_is_no_end(tmp_path: Path, library: str) -> None:
    whole = write(
        tmp_path / "whole.mp4", [busy(i % 9) for i in range(160)], codec="mpeg4", rate=25, options={"g": "10"}
    )
    lost = range(15, 115)
    path = rewritten(tmp_path / "walk.mp4", whole, lambda n, packet: bytes(len(packet)) if n in lost else packet)
    source = open_source(path, most_broken=1.0)
    assert names(source) == [*range(15), *range(115, 160)]
    assert [frame.name for frame in source.skipped] == [f"frame-{number:06d}" for number in lost]


def test_a_damaged_beginning_of_avi_shifts_no_frame(tmp_path: Path, library: str) -> None:
    """It states no times of presentation: what is decoded is put into order, also where the first frames fail."""
    whole = write(tmp_path / "whole.avi", [busy(i) for i in range(24)], options={"bf": "2", "b-adapt": "0", "g": "12"})
    path = rewritten(tmp_path / "walk.avi", whole, lambda n, packet: bytes(len(packet)) if n == 2 else packet)
    source = open_source(path)
    frames = list(source)
    assert len(frames) + len(source.skipped) == 24 and len(source.skipped) == 1
    assert (np.diff(times(frames)) > 0.05).all()


def test_the_first_damaged_frame_is_an_error_when_strict(tmp_path: Path, library: str) -> None:
    path, broken = damaged(tmp_path / "noise.mp4", [7, 15])
    frames = iter(open_source(path, strict=True))
    with pytest.raises(InputError, match=rf"noise\.mp4: {broken[0]} cannot be decoded"):
        list(frames)


def test_too_much_damage_is_an_error(tmp_path: Path, library: str) -> None:
    path, _ = damaged(tmp_path / "noise.mp4", [7, 10, 15])
    with pytest.raises(InputError, match=r"noise\.mp4: 3 of 24 frames cannot be decoded.* more than 5%"):
        list(open_source(path))
    source = open_source(path, most_broken=0.2)
    assert len(list(source)) == 21
    assert len(source.skipped) == 3


@pytest.mark.parametrize("codec", ["libvpx", "libvpx-vp9"])
def test_an_end_that_cannot_be_decoded_is_no_early_end(tmp_path: Path, library: str, codec: str) -> None:
    path = write(tmp_path / "walk.webm", [busy(i) for i in range(24)], codec=codec, options={"g": "12"})
    if codec == "libvpx" and library == "opencv":
        refused(path)
        return
    content = path.read_bytes()
    with av.open(str(path)) as container:
        stored = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    source = open_source(path)
    assert len(list(source)) == 24 and not source.skipped
    for packet in stored[12:]:
        content = content.replace(packet, np.random.default_rng(0).bytes(len(packet)))
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"walk\.webm: 3 of 24 frames cannot be decoded"):
        list(open_source(path))


def test_nothing_that_can_be_decoded(tmp_path: Path, library: str) -> None:
    path, _ = damaged(tmp_path / "noise.mp4", range(24))
    with pytest.raises(InputError, match=r"noise\.mp4 holds no frame that"):
        open_source(path)


def test_a_video_cut_short_says_so(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "whole.mp4", [busy(i) for i in range(24)])
    # The index stands at the front.
    moved = tmp_path / "cut.mp4"
    with av.open(str(path)) as container, av.open(str(moved), "w", options={"movflags": "faststart"}) as output:
        stream = output.add_stream_from_template(container.streams.video[0])
        for packet in container.demux(video=0):
            if packet.size:
                packet.stream = stream
                output.mux(packet)
    position = packets(moved)[12][0]
    moved.write_bytes(moved.read_bytes()[:position])
    source = open_source(moved, most_broken=1.0)
    with pytest.warns(UserWarning, match=r"ends early: 1\d frames decoded, its header announces 24"):
        frames = list(source)
    assert 10 <= len(frames) <= 13
    # Who asks for the first frames only misses none.
    assert len(list(open_source(moved, max_frames=5))) == 5


def test_an_edited_video_is_whole(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "edited.mp4", [grey(i) for i in range(24)], options={"g": "8", "bf": "0"})
    content = bytearray(path.read_bytes())
    # Its edit list shows the second half: duration and first time stamp, here in 1 / 1000 and 1 / 10240 s.
    place = content.index(b"elst") + 12
    with av.open(str(path)) as container:
        second = round(1 / container.streams.video[0].time_base)
    content[place : place + 8] = (1200).to_bytes(4, "big") + second.to_bytes(4, "big")
    path.write_bytes(content)
    source = open_source(path)
    frames = list(source)
    assert source.expected_frames == len(frames) == 12
    assert source.notes == [
        f"{path} shows 12 of the 24 frames in it: it was cut without encoding it anew, holds empty ones where nothing "
        "changes, or its index is damaged"
    ]
    assert abs(frames[0].image.mean() - 40 - 8 * 10) < 10


@pytest.mark.parametrize("frames", [3, 12])
def test_a_beginning_that_an_edit_list_leaves_out_is_not_missing(tmp_path: Path, library: str, frames: int) -> None:
    path = write(tmp_path / "cut.mp4", [grey(i) for i in range(24)], options={"g": "24", "bf": "0"})
    content = bytearray(path.read_bytes())
    place = content.index(b"elst") + 12
    with av.open(str(path)) as container:
        begin = round(frames / 10 / container.streams.video[0].time_base)
    content[place : place + 8] = (2400 - 100 * frames).to_bytes(4, "big") + begin.to_bytes(4, "big")
    path.write_bytes(content)
    source = open_source(path, strict=True)
    shown = list(source)
    assert len(shown) == 24 - frames and not source.skipped
    assert abs(shown[0].image.mean() - 40 - 8 * frames) < 6


@pytest.mark.parametrize(("suffix", "count"), [("mp4", "2"), ("flv", "several"), ("asf", "several")])
def test_files_that_were_appended_are_told(tmp_path: Path, library: str, suffix: str, count: str) -> None:
    one = write(tmp_path / f"one.{suffix}", [grey(i) for i in range(4)])
    path = tmp_path / f"both.{suffix}"
    path.write_bytes(one.read_bytes() * 2)
    source = open_source(path)
    assert len(list(source)) == 4
    assert f"both.{suffix} holds {count} videos one after the other, of which the first alone is" in source.notes[0]


def test_flv_whose_clock_goes_back_goes_on_in_time(tmp_path: Path, library: str) -> None:
    one = write(tmp_path / "one.flv", [grey(i) for i in range(8)])
    path = tmp_path / "joined.flv"
    # Without the header of the second.
    path.write_bytes(one.read_bytes() + one.read_bytes()[13:])
    frames = list(open_source(path, strict=True))
    np.testing.assert_allclose(times(frames), np.arange(16) / 10, atol=1e-3)
    np.testing.assert_allclose([frame.image.mean() for frame in frames], [40 + 8 * (i % 8) for i in range(16)], atol=3)


@pytest.mark.parametrize("codec", ["mpeg4", "mpeg2video", "libvpx-vp9"])
def test_matroska_files_that_were_appended_go_on_in_time(tmp_path: Path, library: str, codec: str) -> None:
    options = {} if codec == "libvpx-vp9" else {"bf": "2"}
    path = write(tmp_path / "walk.mkv", [busy(i) for i in range(24)], codec=codec, rate=25, options=options)
    path.write_bytes(path.read_bytes() * 2)
    source = open_source(path)
    assert names(source) == list(range(48))
    assert not source.skipped and not source.notes


def test_an_index_that_is_repeated_before_a_fragment_is_no_second_video(tmp_path: Path, library: str) -> None:
    """As recorders of streams do that begin each part anew: the library goes on from one to the next."""
    whole = write(tmp_path / "whole.mp4", [grey(i) for i in range(16)], options={"g": "4", "bf": "0"})
    path = rewritten(
        tmp_path / "parts.mp4", whole, options={"movflags": "frag_keyframe+empty_moov+default_base_moof+skip_trailer"}
    )
    content = path.read_bytes()
    fragments = [found.start() - 4 for found in re.finditer(b"moof", content)]
    head, middle = content[: fragments[0]], fragments[2]
    path.write_bytes(content[:middle] + head + content[middle:])
    source = open_source(path)
    assert len(list(source)) == 16
    assert not [note for note in source.notes if "one after the other" in note]


def test_recordings_that_were_joined_may_each_begin_in_the_middle(tmp_path: Path, library: str) -> None:
    part = write(tmp_path / "part.ts", [busy(i) for i in range(24)], codec="mpeg2video", options={"g": "12", "bf": "0"})
    content = part.read_bytes()
    # What describes the stream, then the video from its third frame on.
    cut = content[: 3 * 188] + content[packets(part)[3][0] // 188 * 188 :]
    path = tmp_path / "joined.ts"
    path.write_bytes(cut + cut)
    source = open_source(path, most_broken=1.0)
    frames = list(source)
    assert any("begins in the middle" in note for note in source.notes)
    assert [*names(frames), *(int(each.name[6:]) for each in source.skipped)] == list(range(len(frames)))
    # All but what precedes the first key frame; FFmpeg's decoder may lose a frame at the joint.
    assert len(frames) >= 12 + 20


def test_a_damaged_index_of_a_short_video_is_told(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "walk.mp4", [busy(i) for i in range(6)], codec="mpeg4")
    content = bytearray(path.read_bytes())
    # The fourth frame's size, so that the two after it lie beyond the file's end.
    content[content.index(b"stsz") + 16 + 3 * 4 + 2] |= 0x80
    path.write_bytes(content)
    source = open_source(path)
    assert len(list(source)) == 4
    assert any("shows 4 of the 6 frames in it" in note for note in source.notes)


def test_a_matroska_video_cut_short_says_so(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "cut.mkv", [busy(i) for i in range(24)])
    path.write_bytes(path.read_bytes()[: packets(path)[12][0]])
    with pytest.warns(UserWarning, match=r"ends early: 1\.\d+ s decoded, its header announces 2\.4 s"):
        assert len(list(open_source(path, most_broken=1.0))) >= 10


@pytest.mark.parametrize(("name", "sound"), [("walk.mkv", False), ("walk.webm", False), ("walk.mkv", True)])
def test_a_matroska_video_that_is_damaged_to_its_end_says_so(
    tmp_path: Path, library: str, name: str, sound: bool
) -> None:
    path = write(tmp_path / name, [busy(i) for i in range(40)], codec="libvpx-vp9", rate=25)
    if sound:
        path = with_sound(tmp_path / "sound.mkv", path, seconds=9.0)
    content = path.read_bytes()
    assert len(list(open_source(path))) == 40
    place = packets(path)[20][0]
    path.write_bytes(content[:place] + b"\xff" * (len(content) - place))
    with pytest.warns(UserWarning, match=r"ends early: 0\.\d+ s decoded, its header announces 1\.(6|56) s"):
        assert len(list(open_source(path, most_broken=1.0))) <= 20


def test_an_mxf_video_cut_short_says_so(tmp_path: Path) -> None:
    path = write(tmp_path / "cut.mxf", [busy(i) for i in range(24)], codec="mpeg2video", rate=25)
    assert len(list(open_source(path))) == 24
    end = packets(path)[-1]
    # Without its index at the end, but whole pictures.
    path.write_bytes(path.read_bytes()[: end[0] + 20 + end[1]])
    source = open_source(path)
    assert len(list(source)) == 24 and not source.skipped
    path.write_bytes(path.read_bytes()[: packets(path)[12][0]])
    with pytest.warns(
        UserWarning, match=r"ends early: (0\.4\d* s|12 frames) decoded, its header announces (0\.96 s|24)"
    ):
        assert len(list(open_source(path, most_broken=1.0))) >= 10


@pytest.mark.parametrize("place", [0.02, 0.5, 0.8, 1.0])
def test_a_gif_cut_short_says_so(tmp_path: Path, library: str, place: float) -> None:
    whole = write(tmp_path / "whole.gif", [busy(i) for i in range(8)], codec="gif", pixels="rgb8")
    content = whole.read_bytes()
    assert not [note for note in open_source(whole).notes if "its end" in note]
    path = tmp_path / "cut.gif"
    # Where the pictures begin, the end of the last one, and between.
    first = content.index(b",")
    path.write_bytes(content[: first + 400 + int((len(content) - 1 - first - 400) * place)])
    assert "cut.gif lacks its end" in open_source(path).notes[0]


GROUP = {"g": "12", "bf": "2"}
QUICK = {"g": "12", "deadline": "realtime", "cpu-used": "8"}
FRAGMENTS = {"movflags": "frag_keyframe+empty_moov+default_base_moof"}
# Name, codec, pixel format, its options, and the container's.
KINDS: dict[str, tuple[str, str, dict[str, str], dict[str, str]]] = {
    "h264.mp4": ("libx264", "yuv420p", GROUP, {}),
    "fragments.mp4": ("libx264", "yuv420p", GROUP, FRAGMENTS),
    "h264.mkv": ("libx264", "yuv420p", GROUP, {}),
    "h264.ts": ("libx264", "yuv420p", GROUP, {}),
    "h264.flv": ("libx264", "yuv420p", GROUP, {}),
    "h264.nut": ("libx264", "yuv420p", GROUP, {}),
    "h264.asf": ("libx264", "yuv420p", GROUP, {}),
    "bare.h264": ("libx264", "yuv420p", GROUP, {}),
    "hevc.mp4": ("libx265", "yuv420p", {"x265-params": "log-level=none:keyint=12"}, {}),
    "hevc.ts": ("libx265", "yuv420p", {"x265-params": "log-level=none:keyint=12"}, {}),
    "mpeg4.avi": ("mpeg4", "yuv420p", GROUP, {}),
    "mpeg4.asf": ("mpeg4", "yuv420p", GROUP, {}),
    "wmv2.wmv": ("wmv2", "yuv420p", {"g": "12"}, {}),
    "flv1.flv": ("flv", "yuv420p", {"g": "12"}, {}),
    "mpeg2.mpg": ("mpeg2video", "yuv420p", GROUP, {}),
    "mpeg2.asf": ("mpeg2video", "yuv420p", GROUP, {}),
    "mpeg2.mxf": ("mpeg2video", "yuv420p", GROUP, {}),
    "bare.m2v": ("mpeg2video", "yuv420p", GROUP, {}),
    "vp8.webm": ("libvpx", "yuv420p", QUICK, {}),
    "vp8.ivf": ("libvpx", "yuv420p", QUICK, {}),
    "vp9.mkv": ("libvpx-vp9", "yuv420p", QUICK, {}),
    "vp9.ivf": ("libvpx-vp9", "yuv420p", QUICK, {}),
    "mjpeg.avi": ("mjpeg", "yuvj420p", {}, {}),
    "mjpeg.mov": ("mjpeg", "yuvj420p", {}, {}),
    "bare.mjpeg": ("mjpeg", "yuvj420p", {}, {}),
    "ffv1.mkv": ("ffv1", "yuv420p", {}, {}),
    "huffyuv.avi": ("huffyuv", "yuv422p", {}, {}),
    "raw.y4m": ("wrapped_avframe", "yuv420p", {}, {}),
    "raw10.y4m": ("wrapped_avframe", "yuv420p10le", {}, {}),
    "raw.avi": ("rawvideo", "yuv420p", {}, {}),
    "walk.gif": ("gif", "rgb8", {}, {}),
}
# What is told of any file of its kind.
_OF_KIND = ("states no times",)


def of_kind(tmp_path: Path, name: str, *, late: int = 0) -> Path:
    """A whole video of this kind, whose first frame is shown so many steps after the file's clock begins."""
    codec, pixels, options, container = KINDS[name]
    images = [np.roll(busy(i // 8), 2 * i, 1) for i in range(40)]
    options = options | ({"strict": "-1"} if "10" in pixels else {})
    return write(
        tmp_path / name,
        images,
        codec=codec,
        pixels=pixels,
        rate=25,
        options=options,
        stamps=[i + late for i in range(40)],
        container_options=container | ({"strict": "-1"} if "10" in pixels else {}),
    )


def read_all(path: Path) -> tuple[list[str], list[int], list[str]]:
    """All that is said of a video, but what is said of any of its kind, and the frames that are taken and left out."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            source = open_source(path, most_broken=1.0)
        except InputError as error:
            return [str(error)], [], []
        taken = []
        try:
            taken += names(source)
        except InputError as error:
            return [str(error)], taken, [frame.name for frame in source.skipped]
    notes = [note for note in source.notes if not any(each in note for each in _OF_KIND)]
    said = [*notes, *(frame.reason for frame in source.skipped), *(str(each.message) for each in warned)]
    return said, taken, [frame.name for frame in source.skipped]


def told(path: Path) -> list[str]:
    """All that is said of a video, but what is said of any of its kind."""
    return read_all(path)[0]


@pytest.mark.parametrize("name", KINDS)
def test_whole_videos_of_every_kind_draw_no_word(tmp_path: Path, library: str, name: str) -> None:
    path = of_kind(tmp_path, name)
    if library == "opencv" and name in REFUSED_BY_OPENCV:
        refused(path)
        return
    assert told(path) == []


@pytest.mark.parametrize("name", ["h264.flv", "h264.asf", "mpeg4.asf", "wmv2.wmv", "flv1.flv", "h264.mkv", "h264.ts"])
def test_what_begins_late_ends_no_earlier(tmp_path: Path, library: str, name: str) -> None:
    assert told(of_kind(tmp_path, name, late=125)) == []


def with_sound(path: Path, source: Path, seconds: float) -> Path:
    """A copy beside whose pictures there is silence for so long."""
    with av.open(str(source)) as container, av.open(str(path), "w") as output:
        stream, sound = (
            output.add_stream_from_template(container.streams.video[0]),
            output.add_stream("libmp3lame", 44100),
        )
        for number in range(round(seconds * 44100 / 1152)):
            frame = av.AudioFrame.from_ndarray(np.zeros((2, 1152), np.float32), "fltp", "stereo")
            frame.sample_rate, frame.pts, frame.time_base = 44100, 1152 * number, Fraction(1, 44100)
            output.mux(sound.encode(frame))
        for packet in container.demux(video=0):
            if packet.size:
                packet.stream = stream
                output.mux(packet)
    return path


def test_a_duration_that_ends_before_the_first_frame_is_none(tmp_path: Path, library: str) -> None:
    path = of_kind(tmp_path, "wmv2.wmv", late=125)
    content = bytearray(path.read_bytes())
    place = content.index(bytes.fromhex("a1dcab8c47a9cf118ee400c00c205365")) + 64
    content[place : place + 8] = (45_000_000).to_bytes(8, "little")  # 3.1 s lead in
    path.write_bytes(content)
    assert names(open_source(path)) == list(range(40))


def test_of_sound_that_goes_on_pictures_are_not_missing(tmp_path: Path, library: str) -> None:
    assert told(with_sound(tmp_path / "long.flv", of_kind(tmp_path, "h264.flv"), seconds=4.0)) == []


def sixths(content: bytes) -> list[bytes]:
    step = -(-len(content) // 6)
    return [content[place : place + step] for place in range(0, len(content), step)]


# A sixth is zeros, a sixth is not there, the file ends at three fifths, or within its last packet.
DAMAGES: dict[str, Callable[[bytes, int], bytes]] = {
    "zeros": lambda content, _: b"".join(
        bytes(len(part)) if number == 2 else part for number, part in enumerate(sixths(content))
    ),
    "hole": lambda content, _: b"".join(part for number, part in enumerate(sixths(content)) if number != 2),
    "cut": lambda content, _: content[: len(content) * 3 // 5],
    "end": lambda content, last: content[:last],
}


# Of a damaged packet of FLV no time is known: OpenCV names its frame by the gap, PyAV not at all.
TOLD_OTHERWISE = (("h264.flv", "zeros"), ("h264.flv", "hole"))


@pytest.mark.parametrize("name", sorted(KINDS.keys() - set(REFUSED_BY_OPENCV)))
def test_damage_that_pyav_tells_is_told_by_opencv(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    path = of_kind(tmp_path, name)
    content, last = path.read_bytes(), max((place, size) for place, size, _ in packets(path) if place)
    told_by_any = False
    for kind, change in DAMAGES.items():
        path.write_bytes(change(content, last[0] + last[1] // 2))
        by_pyav, *frames_of_pyav = read_all(path)
        with monkeypatch.context() as hidden:
            hidden.setitem(sys.modules, "av", None)
            by_opencv, *frames_of_opencv = read_all(path)
        told_by_any = told_by_any or bool(by_pyav)
        assert bool(by_opencv) >= bool(by_pyav)
        if (name, kind) not in TOLD_OTHERWISE:
            assert frames_of_opencv == frames_of_pyav, kind
    assert told_by_any
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("walk.apng", "apng", "rgb24"),
        ("walk.ogv", "libvpx", "yuv420p"),
        ("prores.mov", "prores_ks", "yuv422p10le"),
        ("jpeg2000.mov", "jpeg2000", "yuv420p"),
        ("svq1.mov", "svq1", "yuv410p"),
        ("utvideo.avi", "utvideo", "yuv420p"),
        ("magicyuv.avi", "magicyuv", "yuv420p"),
        ("zmbv.avi", "zmbv", "bgr0"),
    ],
)
def test_what_opencv_would_read_in_silence_is_refused(
    tmp_path: Path, opencv_only: None, name: str, codec: str, pixels: str
) -> None:
    refused(write(tmp_path / name, [grey(i) for i in range(6)], codec=codec, pixels=pixels))


@pytest.mark.parametrize("name", sorted(KINDS.keys() - set(REFUSED_BY_OPENCV)))
def test_flipped_bits_that_pyav_tells_are_told_by_opencv(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, rng = of_kind(tmp_path, name), np.random.default_rng(8)
    whole = path.read_bytes()
    places = [(place, size) for place, size, _ in packets(path) if place]
    for _ in range(8):
        content = bytearray(whole)
        for place, size in rng.choice(places, rng.choice([1, 3])):
            # Most often in what packets begin with, of which decoders tell more than of what follows.
            within = min(size, 40) if rng.random() < 0.5 else size
            content[min(place + rng.integers(within), len(whole) - 1)] ^= 1 << rng.integers(8)
        path.write_bytes(content)
        by_pyav = told(path)
        with monkeypatch.context() as hidden:
            hidden.setitem(sys.modules, "av", None)
            assert bool(told(path)) >= bool(by_pyav)


def test_damage_just_before_a_key_frame_is_told(tmp_path: Path, library: str) -> None:
    """As PyAV, which looks two packets ahead for the place where recordings are joined."""
    path = of_kind(tmp_path, "h264.ts")
    place, _, _ = packets(path)[22]
    content = bytearray(path.read_bytes())
    content[place // 188 * 188 + 1] ^= 0x08  # as of another stream
    path.write_bytes(content)
    assert any("lacks frames before frame-0000" in each for each in told(path))


def test_a_stream_that_appears_on_the_way_is_left_alone(tmp_path: Path, library: str) -> None:
    """PyAV stumbles over it at the end of the file."""
    path = of_kind(tmp_path, "h264.ts")
    place, _, _ = packets(path)[30]
    content = bytearray(path.read_bytes())
    content[place // 188 * 188 + 2] ^= 0x40
    path.write_bytes(content)
    assert len(list(open_source(path, most_broken=1.0))) >= 38


def test_files_are_refused_where_errors_cannot_be_heard(
    tmp_path: Path, opencv_only: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with an OpenCV that holds its FFmpeg within itself."""
    path = write(tmp_path / "walk.mp4", [grey(i) for i in range(6)])
    monkeypatch.setattr(opencv_messages, "_library", lambda: None)
    with pytest.raises(InputError, match=r"FFmpeg of this OpenCV cannot be asked .*damage.*: pip install .*\[video\]"):
        open_source(path)


@pytest.mark.parametrize("there", [True, False])
def test_files_are_refused_of_which_mediainfo_tells_nothing(
    tmp_path: Path, opencv_only: None, monkeypatch: pytest.MonkeyPatch, there: bool
) -> None:
    path = write(tmp_path / "walk.mp4", [grey(i) for i in range(6)])
    monkeypatch.setattr(media_info.MediaInfo, "can_parse", lambda: there)
    monkeypatch.setattr(media_info.MediaInfo, "parse", lambda _: SimpleNamespace(video_tracks=[]))
    why = "knows nothing of it" if there else "is not there for this system"
    with pytest.raises(InputError, match=rf"cannot be checked for HDR.*, as MediaInfo {why}: pip install .*\[video\]"):
        open_source(path)
    assert len(list(open_source(of_kind(tmp_path, "walk.gif")))) == 40


def test_a_gif_that_is_damaged_between_its_pictures_says_so(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "walk.gif", [grey(2 * i) for i in range(8)], codec="gif", pixels="rgb8")
    content = bytearray(path.read_bytes())
    place = content.index(b"\x21\xf9", len(content) // 2)  # where a picture begins
    path.write_bytes(content[:place] + b"?" + content[place:])
    (note,) = [note for note in open_source(path).notes if "OpenCV" not in note]
    assert "walk.gif lacks its end" in note


@pytest.mark.parametrize("suffix", ["ts", "m2ts"])
def test_a_transport_stream_cut_within_a_packet_says_so(tmp_path: Path, library: str, suffix: str) -> None:
    path = write(tmp_path / f"walk.{suffix}", [busy(i) for i in range(20)])
    assert open_source(path).notes == []
    path.write_bytes(path.read_bytes()[:-100])
    assert f"walk.{suffix} lacks its end" in open_source(path).notes[0]


def test_packets_that_a_transport_stream_lost_are_told(tmp_path: Path, library: str) -> None:
    """The library marks the frames in which they are missing, whatever the codec."""
    options = {"g": "40", "b": "2000k"}
    path = write(tmp_path / "walk.ts", [busy(i) for i in range(40)], codec="mpeg2video", options=options)
    content = path.read_bytes()
    place = len(content) // 188 // 2 * 188
    path.write_bytes(content[:place] + content[place + 188 :])
    source = open_source(path)
    list(source)
    # Where recordings are joined packets are counted anew, and none is lost.
    path.write_bytes(content * 2)
    joined = open_source(path)
    assert len(list(joined)) == 80 and joined.notes == []
    told = re.compile(r"lacks frames before frame-0000\d\d, .* or part of these")
    assert [note for note in source.notes if told.search(note)]


def test_a_part_of_matroska_that_is_lost_is_told(tmp_path: Path, library: str) -> None:
    """Nothing but the times tells it: the library goes on with the next part that it finds."""
    images = [busy(i) for i in range(60)]
    path = write(tmp_path / "walk.mkv", images, options={"g": "10", "bf": "0", "x264-params": "keyint=10"})
    clusters = [found.start() for found in re.finditer(b"\x1f\x43\xb6\x75", path.read_bytes())]
    source = open_source(path)
    assert len(list(source)) == 60 and source.notes == [] and len(clusters) > 2
    content = bytearray(path.read_bytes())
    content[clusters[2] : clusters[2] + 40] = bytes(40)
    path.write_bytes(content)
    source = open_source(path)
    taken = len(list(source))
    assert taken < 60
    assert [note for note in source.notes if re.search(r"shows nothing for \S+ s after frame-\d+: .*damaged", note)]


def test_a_pause_that_the_file_states_is_none(tmp_path: Path) -> None:
    stamps = [*range(20), *range(50, 70)]
    images = [grey(i % 8) for i in range(40)]
    source = open_source(write(tmp_path / "paused.mp4", images, stamps=stamps, options={"bf": "0"}))
    assert len(list(source)) == 40 and source.notes == []


@pytest.mark.parametrize(
    ("stamps", "found"),
    [
        (range(40), []),
        ([*range(20), *range(35, 55)], [(19, 16.0)]),
        ([*range(20), *range(10**9, 10**9 + 20)], []),
        # A phone that drops ten of 60 frames a second now and then.
        (np.delete(np.arange(600) / 60, [*range(99, 109), *range(400, 410)]), []),
        # Too few to be even; as many long steps as short ones; frames of a screen on which something moves at times.
        ([*range(5), *range(35, 40)], []),
        ([2.9 * n + (n % 2) for n in range(40)], []),
        (np.cumsum([1, 1, 4] * 20), []),
    ],
)
def test_pauses_are_told_where_frames_are_even(stamps: Sequence[float], found: list[tuple[int, float]]) -> None:
    pauses = Pauses()
    for stamp in stamps:
        pauses.add(float(stamp), None)
    assert pauses.found() == found


def test_what_follows_the_end_of_a_gif_is_no_part_of_it(tmp_path: Path, library: str) -> None:
    pictures = [Image.fromarray(busy(i)) for i in range(4)]
    path = tmp_path / "walk.gif"
    # With colours of each picture, a comment, and what a server appended.
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=100, comment=b";,!" * 200)
    path.write_bytes(path.read_bytes() + b"\0" * 9 + b"\r\n")
    source = open_source(path)
    assert len(list(source)) == 4
    assert not [note for note in source.notes if "its end" in note]


def test_a_header_that_was_never_filled_in_announces_nothing(tmp_path: Path, library: str) -> None:
    """As recorders leave it that are cut off, or write to a pipe."""
    path = write(tmp_path / "killed.avi", [busy(i) for i in range(8)], codec="mjpeg", pixels="yuvj420p")
    content = bytearray(path.read_bytes())
    for place in (content.index(b"avih") + 24, content.index(b"strh") + 40):
        content[place : place + 4] = (1 << 30).to_bytes(4, "little")
    content[content.index(b"idx1") :] = b""
    path.write_bytes(content)
    source = open_source(path)
    assert source.expected_frames is None
    assert len(list(source)) == 8


@pytest.mark.parametrize("name", ["screen.mkv", "screen.webm"])
def test_a_last_frame_that_is_shown_for_long_is_no_early_end(tmp_path: Path, library: str, name: str) -> None:
    path = tmp_path / name
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libvpx-vp9" if name.endswith("webm") else "mpeg4", rate=10)
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
        stored = [packet for i in range(4) for packet in stream.encode(av.VideoFrame.from_ndarray(grey(i), "rgb24"))]
        stored += stream.encode(None)
        stored[-1].duration = round(30 / stored[-1].time_base)
        container.mux(stored)
    assert len(list(open_source(path))) == 4


def test_a_file_in_fragments_is_expected_whole(tmp_path: Path, library: str) -> None:
    path = tmp_path / "fragments.mp4"
    images = [grey(i) for i in range(24)]
    with av.open(str(path), "w", options={"movflags": "frag_keyframe"}) as container:
        stream = container.add_stream("libx264", rate=10, options={"g": "4", "bf": "0"})
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        container.mux(stream.encode(None))
    with av.open(str(path)) as container:
        assert container.streams.video[0].frames == 4, "the header states all frames"
    assert open_source(path).expected_frames == len(list(open_source(path))) == 24
    assert not open_source(path).notes
    content = path.read_bytes()
    path.write_bytes(content[: content.rindex(b"moof") + 20])
    source = open_source(path)
    assert len(list(source)) == 20 and any("lacks its end" in note for note in source.notes)


def test_the_unit_of_time_is_no_rate(tmp_path: Path) -> None:
    path = tmp_path / "tape.dv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("dvvideo", rate=25)
        stream.height, stream.width, stream.pix_fmt = 576, 720, "yuv420p"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey(0, 576, 720), "rgb24")))
        container.mux(stream.encode(None))
    source = open_source(path)
    assert source.expected_frames == 3
    np.testing.assert_allclose(times(list(source)), np.arange(3) / 25)


def test_of_several_videos_in_a_file_the_one_that_is_read_is_named(tmp_path: Path, library: str) -> None:
    path = tmp_path / "two_lenses.mkv"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("mpeg4", rate=10) for _ in range(2)]
        for stream in streams:
            stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
        for index in range(4):
            for stream, level in zip(streams, (0, 10), strict=True):
                image = av.VideoFrame.from_ndarray(grey(level), "rgb24") if index < 3 else None
                container.mux(stream.encode(image))
    source = open_source(path)
    assert next(iter(source)).image.mean() < 60
    first, other = ("0:0", "0:1") if library == "pyav" else ("0:v:0", "0:v:1")
    assert source.notes[0] == (
        f"{path} holds 2 videos, 64 x 48 ({first}), 64 x 48 ({other}), of which {first} is read; for another, "
        f"ffmpeg -i INPUT -map {other} -c copy OUTPUT.mkv"
    )


def test_a_video_beside_one_that_cannot_be_decoded_is_read(tmp_path: Path, library: str) -> None:
    path = tmp_path / "two.mkv"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream(codec, rate=10) for codec in ("mpeg4", "libvpx")]
        for stream in streams:
            stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
        for index in range(4):
            for stream in streams:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(grey(index), "rgb24") if index < 3 else None))
    path.write_bytes(path.read_bytes().replace(b"V_VP8", b"V_???"))
    assert names(open_source(path)) == [0, 1, 2]


def test_a_recording_that_begins_in_the_middle(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "whole.ts", [busy(i) for i in range(24)], codec="mpeg2video", options={"g": "12"})
    cut = tmp_path / "cut.ts"
    content = path.read_bytes()
    # The second frame refers to the first, which is missing; what stands in front of it describes the stream.
    cut.write_bytes(content[: 3 * 188] + content[packets(path)[3][0] // 188 * 188 :])
    source = open_source(cut)
    assert any("begins in the middle" in note for note in source.notes)
    frames = list(source)
    assert len(frames) == 12
    for frame, expected in zip(frames, list(open_source(path))[12:], strict=True):
        np.testing.assert_array_equal(frame.image, expected.image)


def trimmed(path: Path, source: Path, first: int, count: int) -> Path:
    """A copy of so many packets from one on, which need not be a key frame; its index stands at the front."""
    return rewritten(
        path,
        source,
        lambda number, packet: packet if first <= number < first + count else None,
        options={"movflags": "faststart"} if path.suffix == ".mp4" else None,
    )


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_beginning_that_is_left_out_is_no_early_end(tmp_path: Path, library: str, suffix: str) -> None:
    """As where a part was copied from between key frames, here after a pause that was recorded as one frame."""
    stamps = [*range(20), *range(60, 100)]
    whole = write(
        tmp_path / "whole.mp4",
        [busy(i) for i in range(60)],
        options={"g": "24", "bf": "0", "sc_threshold": "0"},
        stamps=stamps,
    )
    source = open_source(trimmed(tmp_path / f"part.{suffix}", whole, 14, 30))
    frames = list(source)
    assert len(frames) == 20 and not source.skipped
    assert [
        note for note in source.notes if "10 frames before its first key frame are left out" in note
    ] == source.notes
    if (library, suffix) != ("opencv", "mkv"):  # of which OpenCV knows no duration
        with pytest.raises(InputError, match="lasts 2 s, but start is 3 s"):
            open_source(source.path, start=3)


@pytest.mark.parametrize(("suffix", "told"), [("mp4", r"1\d frames"), ("mkv", r"1\.\d+ s")])
def test_an_early_end_is_told_of_a_part_as_well(tmp_path: Path, library: str, suffix: str, told: str) -> None:
    whole = write(
        tmp_path / "whole.mp4", [busy(i) for i in range(60)], options={"g": "24", "bf": "0", "sc_threshold": "0"}
    )
    path = trimmed(tmp_path / f"part.{suffix}", whole, 14, 40)
    path.write_bytes(path.read_bytes()[: packets(path)[24][0]])
    with pytest.warns(
        UserWarning, match=rf"{told} decoded after the 10 frames that are left out, its header announces 4"
    ):
        list(open_source(path, most_broken=1.0))


def test_the_library_prints_nothing(tmp_path: Path, library: str, capfd: pytest.CaptureFixture[str]) -> None:
    path, _ = damaged(tmp_path / "noise.mp4", [7, 15])
    list(open_source(path))
    assert capfd.readouterr() == ("", "")


# ---- what is no video ----------------------------------------------------------------------------------------------


def without_index(path: Path) -> None:
    write(path, [grey(0)] * 3)
    path.write_bytes(path.read_bytes().replace(b"moov", b"free"))


def audio_only(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        for index in range(3):
            frame = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), "fltp", "stereo")
            frame.rate, frame.pts = 44100, 1024 * index
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def unknown_codec(path: Path) -> None:
    write(path, [grey(0)] * 3)
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzz1"))


def picture(path: Path) -> None:
    path.write_bytes(cv2.imencode(".png", quarters())[1].tobytes())


REFUSED = {
    "empty.mp4": (lambda path: path.touch(), "is empty"),
    "text.mp4": (lambda path: path.write_text("no video\n" * 99), "cannot be opened as a video"),
    "noise.mp4": (lambda path: path.write_bytes(np.random.default_rng(0).bytes(9999)), "cannot be opened as a video"),
    "text.txt": (lambda path: path.write_text("no video\n" * 99), "is text"),
    "index.mp4": (without_index, "lacks its index"),
    "sound.m4a": (audio_only, "no video stream, only audio|cannot be opened as a video"),
    "codec.mp4": (unknown_codec, "codec.*zzz1|cannot be opened as a video"),
    "image.mp4": (picture, "is a single image"),
    "fifo.mp4": (os.mkfifo, "neither a file nor a folder"),
    "loop.mp4": (lambda path: path.symlink_to(path), "symbolic links"),
    "locked.mp4": (lambda path: path.touch(0o000), "is empty|Permission denied"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_video_is_refused_in_one_line(tmp_path: Path, library: str, name: str) -> None:
    make, message = REFUSED[name]
    make(tmp_path / name)
    with pytest.raises(InputError, match=message) as caught:
        open_source(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("option", [{"pattern": "*.jpg"}, {"size_mismatch": "crop"}])
def test_options_of_images_are_refused(tmp_path: Path, option: dict[str, str]) -> None:
    write(tmp_path / "walk.mp4", [grey(0)] * 2)
    (name,) = option
    for path, called in (
        (tmp_path / "walk.mp4", "walk.mp4"),
        ("0", "camera 0"),
        ("rtsp://me:secret@a.b/c", "rtsp://a.b/c"),
    ):
        with pytest.raises(InputError, match=f"^{name} is for files of images, which .*{called} is not: leave it out$"):
            open_source(path, **option)


@pytest.mark.parametrize("path", ["nul\0.mp4", "~no_such_user_here/clip.mp4"])
def test_what_is_no_path_is_refused(path: str) -> None:
    with pytest.raises(InputError, match="is no path"):
        open_source(path)


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        ("ftp://me:secret@127.0.0.1/x.mp4", "ftp://127.0.0.1/x.mp4"),
        (Path("s3://walks/a.jpg"), "s3://walks/a.jpg"),
        ("file://server/x.mp4", "file://server/x.mp4"),
    ],
)
def test_addresses_of_which_nothing_is_read_are_refused(given: str | Path, shown: str) -> None:
    with pytest.raises(InputError, match=f"^{shown} is neither a file nor an address .* begins with rtsp, .* or mms:"):
        open_source(given)


def test_a_pattern_with_a_number_is_told_as_a_glob(tmp_path: Path) -> None:
    with pytest.raises(MissingInput, match=r"img_%04d\.png does not exist.*'.*/img_\*\.png'"):
        open_source(tmp_path / "img_%04d.png")


def test_the_address_of_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(MissingInput, match=rf"^{tmp_path}/x\.mp4 does not exist"):
        open_source(f"file://{tmp_path}/x.mp4")


def test_a_folder_that_looks_like_an_address_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ftp:").mkdir()
    write(tmp_path / "ftp:" / "walk.mp4", [grey(i) for i in range(3)])
    assert len(list(open_source("ftp:/walk.mp4"))) == 3


@pytest.mark.parametrize("name", ["a:b.mp4", "100%d.mp4", "übung 漢字.mp4", "-i.mp4", "file:x.mp4", "q?x=1#y.mp4"])
def test_names_are_taken_as_they_are(tmp_path: Path, library: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "clip.mp4", [grey(i) for i in range(3)]).rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert len(list(open_source(name))) == 3


def test_a_video_with_a_pictures_suffix_is_a_video(tmp_path: Path, library: str) -> None:
    path = write(tmp_path / "walk.mkv", [grey(i) for i in range(4)])
    assert len(list(open_source(path.rename(tmp_path / "walk.jpg")))) == 4
    os.mkfifo(tmp_path / "pipe.jpg")
    with pytest.raises(InputError, match=r"pipe\.jpg is a single image"):
        open_source(tmp_path / "pipe.jpg")


def test_a_name_that_is_no_unicode(tmp_path: Path, library: str) -> None:
    path = tmp_path / os.fsdecode(b"caf\xe9.mp4")
    write(tmp_path / "clip.mp4", [grey(i) for i in range(3)]).rename(path)
    if library == "opencv":
        with pytest.raises(InputError, match="rename it"):
            open_source(path)
    else:
        source = open_source(path)
        assert len(list(source)) == 3
        assert source.fingerprint(3) == source.fingerprint(3)


# ---- cameras and streams -------------------------------------------------------------------------------------------


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    """Of a server for the files of `tmp_path`; of `cut.ts` it sends one half of what it announces."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments, directory=str(tmp_path))

        def do_GET(self) -> None:
            if self.path != "/cut.ts":
                return super().do_GET()
            content = (tmp_path / "cut.ts").read_bytes()
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content[: len(content) // 2])
            return None

        def log_message(self, *arguments: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_a_stream_is_opened_when_it_is_read(tmp_path: Path, address: str) -> None:
    source = open_source(f"{address}/clip.mp4", stride=2)
    assert isinstance(source, VideoSource)
    assert source.expected_frames is None
    assert source.image_size is None
    assert source.fingerprint(3) != source.fingerprint(3)
    # It exists only now.
    write(tmp_path / "clip.mp4", [grey(i) for i in range(6)])
    frames = list(source)
    assert names(frames) == [0, 2, 4]
    assert frames[0].image.shape == (HEIGHT, WIDTH, 3)


def test_what_a_stream_gave_before_it_broke_off_is_taken(tmp_path: Path, address: str) -> None:
    write(tmp_path / "cut.ts", [busy(i) for i in range(12)], options={"g": "4"})
    # A path keeps one slash of an address.
    source = open_source(Path(f"{address}/cut.ts"))
    frames = list(source)
    assert 3 <= len(frames) <= 8
    assert "cannot be read" in source.skipped[0].reason


def test_a_stream_that_cannot_be_reached(address: str) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        closed = free.getsockname()[1]
    for url in (f"rtsp://me:secret@127.0.0.1:{closed}/live", f"{address}/nothing.mp4"):
        source = open_source(url)
        with pytest.raises(InputError, match=r"//127\.0\.0\.1:\d+/\S+ cannot be opened .*check address") as caught:
            list(source)
        assert "secret" not in str(caught.value)


def test_a_stream_that_says_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "_TIMEOUT", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        source = open_source(f"http://127.0.0.1:{silent.getsockname()[1]}/live")
        with pytest.raises(InputError, match=r"0\.5 s"):
            list(source)


def test_streams_are_refused_where_opencv_is_alone(opencv_only: None) -> None:
    """It brings all pictures to the first one's size, and does not tell which frames are missing."""
    with pytest.raises(InputError, match=r"rtsp://10\.0\.0\.7/live is a network stream.*: pip install .*\[video\]"):
        open_source("rtsp://me:secret@10.0.0.7/live")


def test_reads_that_fail_are_no_frames_of_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """As while it warms up, or where a cable is loose."""

    class Camera:
        def __init__(self, *_: object) -> None:
            self.asked = 0

        def isOpened(self) -> bool:
            return True

        def grab(self) -> bool:
            self.asked += 1
            return self.asked > 5 and self.asked not in range(20, 24)

        def retrieve(self) -> tuple[bool, np.ndarray]:
            return True, grey(self.asked % 20)

        def get(self, name: int) -> float:
            return 0.0

        def release(self) -> None:
            pass

    monkeypatch.setattr(cv2, "VideoCapture", Camera)
    source = open_source("0", max_frames=30)
    assert names(list(source)) == list(range(30))
    assert not source.skipped


def test_mediainfo_that_takes_too_long_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, opencv_only: None
) -> None:
    monkeypatch.setattr(media_info, "_PATIENCE", 0.05)
    monkeypatch.setattr(media_info.MediaInfo, "parse", lambda _: time.sleep(0.5))
    with pytest.raises(InputError, match="MediaInfo knows nothing of it"):
        open_source(write(tmp_path / "clip.mp4", [grey(i) for i in range(4)]))


@pytest.mark.parametrize("errors", ["2>&-", "2>/dev/full"])
def test_a_terminal_that_takes_no_errors_is_no_obstacle(tmp_path: Path, errors: str) -> None:
    path = write(tmp_path / "walk.mp4", [grey(i) for i in range(6)])
    program = (
        "import sys; sys.modules['av'] = None; from logvggt_jax.reconstruction.sources import open_source; "
        f"print(len(list(open_source({str(path)!r}))))"
    )
    command = f"{shlex.quote(sys.executable)} -c {shlex.quote(program)} {errors}"
    done = subprocess.run(["sh", "-c", command], stdout=subprocess.PIPE, timeout=60, check=True)
    assert done.stdout == b"6\n"


def test_messages_go_to_the_thread_that_reads(
    tmp_path: Path, opencv_only: None, capfd: pytest.CaptureFixture[str]
) -> None:
    broken = of_kind(tmp_path, "h264.ts")
    content = broken.read_bytes()
    broken.write_bytes(DAMAGES["zeros"](content, 0))
    whole = tmp_path / "whole.ts"
    whole.write_bytes(content)
    alone = told(broken)
    assert alone and capfd.readouterr() == ("", "")
    with warnings.catch_warnings(), ThreadPoolExecutor(6) as pool:
        warnings.simplefilter("ignore")
        sources = [open_source(path, most_broken=1.0) for path in 3 * [broken, whole]]
        read = list(pool.map(lambda source: len(list(source)), sources))
    assert capfd.readouterr() == ("", "")
    assert len(set(read[::2])) == len(set(read[1::2])) == 1
    for source, path in zip(sources, 3 * [broken, whole], strict=True):
        notes = [note for note in source.notes if not any(each in note for each in _OF_KIND)]
        assert set(notes) <= set(alone) and bool(notes) == (path is broken)
    # What nobody listens to is printed as ever.
    capture = cv2.VideoCapture(str(broken), cv2.CAP_FFMPEG)
    while capture.grab():
        pass
    assert "[h264 @ " in capfd.readouterr().err


def test_digits_name_a_camera_unless_they_are_a_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str
) -> None:
    monkeypatch.chdir(tmp_path)
    source = open_source("93")
    assert isinstance(source, VideoSource)
    assert source.expected_frames is None
    with pytest.raises(InputError, match="camera 93 cannot be opened"):
        list(source)
    (tmp_path / "93").mkdir()
    cv2.imwrite(str(tmp_path / "93" / "a.png"), quarters())
    assert len(list(open_source("93"))) == 1


def test_a_camera_gives_frames_until_told_to_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    class Camera:
        def __init__(self, *arguments: object) -> None:
            assert arguments[0] == 0

        def isOpened(self) -> bool:
            return True

        def grab(self) -> bool:
            return True

        def retrieve(self) -> tuple[bool, np.ndarray]:
            return True, quarters()[..., ::-1]

        def get(self, name: int) -> float:
            return 0.0

        def release(self) -> None:
            pass

    monkeypatch.setattr(cv2, "VideoCapture", Camera)
    source = open_source("0", max_frames=5)
    frames = list(source)
    assert source.expected_frames == 5
    assert names(frames) == list(range(5))
    assert (np.diff(times(frames)) > 0).all()
    np.testing.assert_array_equal(frames[0].image, quarters())


# ---- reference files -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def cases_dir() -> Path:
    """Small inputs of kinds that once failed."""
    path = Path(os.environ.get("LOGVGGT_SHARED", Path(__file__).parents[3] / "shared")) / "data" / "cases"
    if not path.exists():
        pytest.skip(f"reference data not found in {path} (set LOGVGGT_SHARED)")
    return path


def test_the_case_of_interlacing(cases_dir: Path) -> None:
    frames = list(open_source(cases_dir / "interlaced.mp4"))
    assert len(frames) == 12
    np.testing.assert_allclose([frame.image.mean() for frame in frames], 84, atol=3)


def test_the_case_of_a_change_of_size(cases_dir: Path, library: str) -> None:
    with pytest.raises(InputError, match="frame 12 is 240 x 320 pixels but the video begins with 320 x 240"):
        list(open_source(cases_dir / "reschange2.ts"))


def test_the_case_of_damage(cases_dir: Path, library: str) -> None:
    source = open_source(cases_dir / "noisemid.mp4")
    assert len(list(source)) == 22
    assert [frame.name for frame in source.skipped] == ["frame-000005", "frame-000009"]


def test_the_case_of_a_varying_rate(cases_dir: Path, library: str) -> None:
    seconds = times(list(open_source(cases_dir / "vfr.mp4")))
    expected = [*np.arange(9) / 12, *np.arange(3, 11) / 3, *(10 / 3 + np.arange(1, 5) / 12)]
    np.testing.assert_allclose(seconds, expected, atol=1e-4)


def test_the_case_of_a_late_start(cases_dir: Path, library: str) -> None:
    seconds = times(list(open_source(cases_dir / "offset.mkv")))
    np.testing.assert_allclose(seconds, np.arange(24) / 12, atol=1e-3)


def test_real_video_opens_and_gives_frames(examples_dir: Path, library: str) -> None:
    frames = list(open_source(examples_dir / "video" / "handheld_box.mp4", max_frames=3))
    assert [frame.image.shape for frame in frames] == [(480, 640, 3)] * 3


def test_real_video_is_counted_by_decoding(examples_dir: Path, library: str) -> None:
    source = open_source(examples_dir / "video" / "handheld_box.mp4")
    assert source.expected_frames == 456
    assert sum(1 for _ in source.loaders()) == 455
    assert not source.skipped
