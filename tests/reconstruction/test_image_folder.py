"""Folders, globs and lists give their pictures in order, and say what they leave out before anything is computed."""

from __future__ import annotations

import os
import re
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base

from logvggt_jax.errors import DiskError, InputError, MissingInput, MissingPackage
from logvggt_jax.reconstruction.sources import FolderSource, SourceFrame, SourceOptions, image_folder, open_source


def write_image(path: Path, value: int, size: tuple[int, int] = (20, 30)) -> None:
    """A picture whose red is `value` and whose green and blue are 0."""
    image = np.zeros((*size, 3), np.uint8)
    image[..., 2] = value
    assert cv2.imwrite(str(path), image)


def write_numbered(folder: Path, count: int, suffix: str = "png", **options: Any) -> None:
    for number in range(count):
        write_image(folder / f"{number}.{suffix}", number, **options)


def truncate(path: Path) -> None:
    """Takes the pixels of a picture away, the last of them at least."""
    path.write_bytes(path.read_bytes()[:-20])


def damage_pixels(path: Path) -> None:
    """What only decoding finds."""
    data = bytearray(path.read_bytes())
    data[data.index(b"IDAT") + 10] ^= 0xFF
    path.write_bytes(data)


def reds(frames: list[SourceFrame]) -> list[int]:
    return [int(frame.image[0, 0, 0]) for frame in frames]


def names(source: Any) -> list[str]:
    return [frame.name for frame in source]


@pytest.fixture
def some_left_out(tmp_path: Path) -> Iterator[Path]:
    """Four pictures, and everything else that has an image's name."""
    for number in (1, 2, 3, 5):
        write_image(tmp_path / f"img{number}.png", number)
    (tmp_path / "img6.png").mkdir()
    os.mkfifo(tmp_path / "img7.png")
    (tmp_path / "img8.png").symlink_to("nowhere.png")
    (tmp_path / "img9.png").symlink_to("img9.png")
    (tmp_path / ".img10.png").write_bytes(b"hidden")
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / "data.json").write_text("{}")
    (tmp_path / "left").mkdir()
    write_numbered(tmp_path / "left", 2)
    with socket.socket(socket.AF_UNIX) as server:
        here = Path.cwd()
        os.chdir(tmp_path)  # names of sockets are short
        server.bind("img11.png")
        os.chdir(here)
        yield tmp_path


def test_folder_is_in_natural_order_and_rgb(tmp_path: Path) -> None:
    for number in (10, 9, 1, 100, 2):
        write_image(tmp_path / f"img{number}.png", number)
    source = open_source(tmp_path)
    assert isinstance(source, FolderSource)
    frames = list(source)
    assert names(frames) == ["img1", "img2", "img9", "img10", "img100"]
    assert reds(frames) == [1, 2, 9, 10, 100]
    assert frames[0].image[0, 0].tolist() == [1, 0, 0]
    assert len(source) == source.expected_frames == 5
    assert source.image_size == (20, 30)
    assert [frame.timestamp for frame in frames] == [0, 1, 2, 3, 4]
    assert source.notes == [] and source.skipped == []


@pytest.mark.parametrize("suffix", ["JPG", "jpeg", "jpe", "jfif", "png", "webp", "tif", "TIFF", "bmp", "avif", "heic"])
def test_every_suffix_of_a_picture_is_taken(tmp_path: Path, suffix: str) -> None:
    Image.new("RGB", (30, 20)).save(tmp_path / f"a.{suffix}", "PNG")
    assert names(open_source(tmp_path)) == ["a"]


def test_everything_that_is_left_out_is_said(some_left_out: Path) -> None:
    source = open_source(some_left_out)
    assert reds(list(source)) == [1, 2, 3, 5]
    for said in (
        r"2 without an image's suffix \(.*1 \.json",
        r"1 folder with an image's name \(img6\.png\)",
        r"1 pipe .*img7\.png",
        r"1 broken link .*img8\.png",
        r"1 looping link .*img9\.png",
        r"1 hidden file .*\.img10\.png",
        r"1 socket .*img11\.png",
        r"numbers 4, 10 are missing between img1 and img11",
        r"sub-folders .*left/ \(2\)",
    ):
        assert sum(re.search(said, note) is not None for note in source.notes) == 1, said
    assert len(source.notes) == 9


def test_seven_scenes_folder_gives_colour_images_only(tmp_path: Path) -> None:
    depth = np.full((20, 30), 1000, np.uint16)
    for index in range(4):
        write_image(tmp_path / f"frame-00000{index}.color.png", index + 1)
        assert cv2.imwrite(str(tmp_path / f"frame-00000{index}.depth.png"), depth)
        (tmp_path / f"frame-00000{index}.pose.txt").touch()
    assert cv2.imwrite(str(tmp_path / "frame-000002.depth.proj.png"), depth)
    source = open_source(tmp_path)
    assert reds(list(source)) == [1, 2, 3, 4] and source.notes == []
    assert names(source) == ["frame-000000", "frame-000001", "frame-000002", "frame-000003"]
    (tmp_path / "frame-000001.color.png").unlink()
    damaged = open_source(tmp_path)
    assert reds(list(damaged)) == [1, 3, 4]
    for said in (r"1 depth maps without .*000001\.depth\.png", "number 1 is missing"):
        assert sum(re.search(said, note) is not None for note in damaged.notes) == 1, said


@pytest.mark.parametrize("companion", [None, "sample.pose.txt"])
def test_a_stray_colour_image_hides_nothing(tmp_path: Path, companion: str | None) -> None:
    write_numbered(tmp_path, 3)
    write_image(tmp_path / "sample.color.png", 9)
    if companion is not None:
        (tmp_path / companion).touch()
    assert reds(list(open_source(tmp_path))) == [0, 1, 2, 9]


def test_names_differ_where_stems_do_not(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", 1)
    write_image(tmp_path / "a.jpg", 1)
    source = open_source(tmp_path)
    assert names(source) == ["a.jpg", "a.png"]
    assert "2 images have the name of another but for the suffix" in source.notes[0]


def test_masks_among_pictures_draw_a_note_that_names_the_pattern(tmp_path: Path) -> None:
    for index in range(2):
        write_image(tmp_path / f"00{index}.jpg", 0)
        write_image(tmp_path / f"00{index}_mask.png", 0)
    source = open_source(tmp_path)
    assert len(source) == 4 and len(source.notes) == 1
    assert re.search(r"2 of 4 names look like masks.*--pattern '\*\.jpg'", source.notes[0])
    chosen = open_source(tmp_path, pattern="*.jpg")
    assert names(chosen) == ["000", "001"] and chosen.notes == []


def test_depth_maps_are_refused_as_such(tmp_path: Path) -> None:
    millimetres = np.linspace(400, 9000, 600).reshape(20, 30).astype(np.uint16)
    assert cv2.imwrite(str(tmp_path / "0.png"), millimetres)
    with pytest.raises(InputError, match=r"0\.png.*depth map"):
        open_source(tmp_path)
    far = (millimetres.astype(int) * 7).astype(np.uint16)
    far[:5] = 0
    assert cv2.imwrite(str(tmp_path / "0.png"), far)
    with pytest.raises(InputError, match=r"0\.png.*depth map"):
        open_source(tmp_path)


def test_grey_pictures_with_sixteen_bits_are_no_depth_maps(tmp_path: Path) -> None:
    grey = np.tile(np.arange(30, dtype=np.uint16), (20, 1)) * 8
    for step in (256, 257):
        assert cv2.imwrite(str(tmp_path / "0.png"), (grey * np.uint16(step)))
        assert np.array_equal(next(iter(open_source(tmp_path))).image[..., 0], grey)
    assert cv2.imwrite(str(tmp_path / "0.png"), np.random.default_rng(0).integers(0, 65536, (20, 30), np.uint16))
    assert len(open_source(tmp_path)) == 1


def test_names_that_are_times_become_time_stamps(tmp_path: Path) -> None:
    for value, name in enumerate(["1548266469.88868", "1548266469.9022", "1548266469.95", "1548266470.0"]):
        write_image(tmp_path / f"{name}.jpg", 60 * value)
    frames = list(open_source(tmp_path))
    assert [frame.timestamp for frame in frames] == [1548266469.88868, 1548266469.9022, 1548266469.95, 1548266470.0]
    assert names(frames)[0] == "1548266469.88868"
    assert np.abs(np.subtract(reds(frames), [0, 60, 120, 180])).max() < 8


def test_an_order_against_the_cameras_clock_is_told(tmp_path: Path) -> None:
    """A camera's counter that begins anew after 9999."""
    names_in_time = ["DSC_9998.jpg", "DSC_9999.jpg", "DSC_0001.jpg", "DSC_0002.jpg"]
    for second, name in enumerate(names_in_time):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[36867] = f"2026:05:01 12:30:0{second}"
        Image.new("RGB", (30, 20)).save(tmp_path / name, exif=exif)
    (note,) = open_source(tmp_path).notes
    assert note.startswith("by the camera's clock DSC_9998.jpg was taken before DSC_0002.jpg (2026:05:01 12:30:00, ")
    assert "give a list" in note
    (tmp_path / "list.txt").write_text("\n".join(names_in_time))
    assert open_source(tmp_path / "list.txt").notes == []
    assert open_source(tmp_path, pattern="DSC_0*").notes == []


def test_times_choose_frames(tmp_path: Path) -> None:
    for index in range(20):
        write_image(tmp_path / f"{100 + index / 10:.1f}.png", index)
    assert reds(list(open_source(tmp_path, fps=2.0))) == [0, 5, 10, 15]
    assert reds(list(open_source(tmp_path, start=0.45, end=0.85))) == [5, 6, 7, 8]
    assert reds(list(open_source(tmp_path, start=1.0, stride=4, max_frames=2))) == [10, 14]
    with pytest.raises(InputError, match=r"no image of .* lies between start and end"):
        open_source(tmp_path, start=50.0)


@pytest.mark.parametrize("option", ["fps", "start", "end"])
def test_options_of_time_need_times(tmp_path: Path, option: str) -> None:
    write_numbered(tmp_path, 3)
    with pytest.raises(InputError, match=f"{option} needs time stamps"):
        open_source(tmp_path, **{option: 1.0})


def test_stride_and_limit_keep_the_position_as_time(tmp_path: Path) -> None:
    write_numbered(tmp_path, 10)
    source = FolderSource(tmp_path, SourceOptions(stride=3, max_frames=3))
    assert reds(list(source)) == [0, 3, 6]
    assert [frame.timestamp for frame in source] == [0, 3, 6]
    assert len(source) == source.expected_frames == 3


def test_a_picture_is_decoded_only_when_it_is_reached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_numbered(tmp_path, 5)
    read: list[str] = []
    original = image_folder.read_picture
    monkeypatch.setattr(
        image_folder, "read_picture", lambda path, **options: read.append(path.name) or original(path, **options)
    )
    source = open_source(tmp_path)
    frames = iter(source)
    assert read == []
    next(frames)
    next(frames)
    assert read == ["0.png", "1.png"]
    read.clear()
    tail = [load() for load in source.loaders(3)]
    assert [frame.timestamp for frame in tail if frame] == [3, 4] and read == ["3.png", "4.png"]


def test_loaders_give_the_frames_in_whatever_order_they_are_called(tmp_path: Path) -> None:
    write_numbered(tmp_path, 6)
    source = open_source(tmp_path)
    loaded = [load() for load in reversed(list(source.loaders()))][::-1]
    for frame, expected in zip(loaded, source, strict=True):
        assert frame is not None and frame[:2] == expected[:2]
        np.testing.assert_array_equal(frame.image, expected.image)


@pytest.mark.parametrize("orientation", [1, 6])
def test_frames_are_upright_and_know_their_focal_length(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769)[0xA405] = 26
    Image.new("RGB", (40, 30)).save(tmp_path / "a.jpg", exif=exif)
    source = open_source(tmp_path)
    (frame,) = source
    assert source.image_size == frame.image.shape[:2] == ((30, 40) if orientation == 1 else (40, 30))
    assert frame.focal_length == pytest.approx(26 / np.hypot(36, 24) * 50)


def test_globs_choose_over_folders(tmp_path: Path) -> None:
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        write_numbered(tmp_path / side, 11)
    write_image(tmp_path / "left" / "a.jpg", 0)
    source = open_source(tmp_path / "left" / "*.png")
    assert names(source) == [str(number) for number in range(11)]
    assert source.path == tmp_path / "left"
    both = open_source(f"{tmp_path}/*/1*.png")
    assert names(both) == ["left_1.png", "left_10.png", "right_1.png", "right_10.png"]
    assert len(open_source(tmp_path / "**" / "*.png", pattern="2.*")) == 2
    with pytest.raises(MissingInput, match=r"no image matches .*\*\.bmp"):
        open_source(tmp_path / "*.bmp")


def test_a_folder_may_have_the_characters_of_a_glob(tmp_path: Path) -> None:
    (tmp_path / "day [1]").mkdir()
    write_numbered(tmp_path / "day [1]", 2)
    assert len(open_source(tmp_path / "day [1]")) == 2


def test_a_list_names_files_in_its_own_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "in").mkdir()
    write_numbered(tmp_path / "in", 4)
    (tmp_path / "in" / "3.png").rename(tmp_path / "in" / "three")
    listing = tmp_path / "frames.txt"
    listing.write_text(f"# chosen by hand\n\nin/2.png\r\n{tmp_path}/in/0.png\n  in/three\n")
    source = open_source(listing)
    assert reds(list(source)) == [2, 0, 3] and names(source) == ["2", "0", "three"]
    assert source.path == listing
    monkeypatch.chdir(tmp_path)
    assert reds(list(open_source("frames.txt"))) == [2, 0, 3]
    listing.write_text("in\\2.png\r\nin\\0.png\r\n", encoding="utf-16")  # as Windows' shell writes it
    assert reds(list(open_source(listing))) == [2, 0]
    for text, told in (
        ("in/2.png\nin/9.png\n", r"frames\.txt .* line 2 names no file: 'in/9\.png'"),
        ("in\n", r"line 1: 'in' is no file"),
        ("in/2.png\nin/2.png\n", r"line 2: .* is in line 1 already"),
        ("# nothing\n", "no image in .*frames"),
        ("a" * 300, "line 1: "),
    ):
        listing.write_text(text)
        with pytest.raises(InputError, match=told):
            open_source(listing)
    listing.write_bytes(b"\xff\xfe\xff")
    with pytest.raises(InputError, match=r"frames\.txt: no text in UTF-8"):
        open_source(listing)


def test_links_to_pictures_that_are_gone_are_called_so(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"{number}.png").symlink_to(tmp_path.parent / "moved" / f"{number}.png")
    (tmp_path / "notes.txt").write_text("of the day")
    expected = r"found 1 \.txt; 3 broken links \(0\.png, 1\.png, 2\.png\)"
    with pytest.raises(MissingInput, match=expected):
        open_source(tmp_path)
    with pytest.raises(MissingInput, match=r"found 3 broken links"):
        open_source(tmp_path / "*.png")


def test_folders_without_pictures_say_what_they_hold(tmp_path: Path) -> None:
    with pytest.raises(MissingInput, match=f"no image in {tmp_path}.*found nothing"):
        open_source(tmp_path)
    (tmp_path / "rgb").mkdir()
    write_numbered(tmp_path / "rgb", 2)
    for name in ("a.dng", "b.dng", "c.mov"):
        (tmp_path / name).touch()
    with pytest.raises(MissingInput, match=r"found 2 \.dng, 1 \.mov; sub-folders with images: rgb/ \(2\)"):
        open_source(tmp_path)
    with pytest.raises(MissingInput, match=r"none matches --pattern '\*\.jpg'.*found 2 \.png"):
        open_source(tmp_path / "rgb", pattern="*.jpg")


def test_a_folder_with_nothing_but_a_video_or_hidden_files_says_so(tmp_path: Path) -> None:
    (tmp_path / "walk.mp4").touch()
    (tmp_path / "._a.png").touch()
    with pytest.raises(MissingInput, match=r"found 1 hidden \.png, 1 \.mp4; .*the file of a video"):
        open_source(tmp_path)


def test_missing_and_wrong_sources_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"):
        open_source(tmp_path / "nowhere")
    write_image(tmp_path / "one.png", 1)
    with pytest.raises(ValueError, match="single image"):
        open_source(tmp_path / "one.png")


def test_an_empty_path_is_not_the_folder_at_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_numbered(tmp_path, 2)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="path is empty"):
        open_source("")


@pytest.mark.parametrize("address", ["file://{}", "file://localhost{}", "file:{}", "file://{}/*.png"])
def test_a_files_address_is_its_path(tmp_path: Path, address: str) -> None:
    folder = tmp_path / "my photos"
    folder.mkdir()
    write_numbered(folder, 2)
    assert len(list(open_source(address.format(str(folder).replace(" ", "%20"))))) == 2


def test_two_sizes_are_listed_with_their_counts(tmp_path: Path) -> None:
    write_numbered(tmp_path, 3)
    write_image(tmp_path / "5.png", 5, (30, 20))
    write_image(tmp_path / "4.png", 4, (24, 32))
    told = r"3 sizes, some upright and some sideways: 3 of 30 x 20 \(0\.png\); 1 of 32 x 24 \(4\.png\).*--size-mismatch"
    with pytest.raises(InputError, match=told):
        open_source(tmp_path)
    skipping = open_source(tmp_path, size_mismatch="skip")
    assert reds(list(skipping)) == [0, 1, 2] and skipping.image_size == (20, 30)
    assert any("2 of another size than 30 x 20 (4.png, 5.png)" in note for note in skipping.notes)
    cropping = open_source(tmp_path, size_mismatch="crop")
    assert cropping.image_size == (20, 20)
    assert [frame.image.shape for frame in cropping] == [(20, 20, 3)] * 5


def test_thumbnails_of_another_size_are_suspected(tmp_path: Path) -> None:
    write_numbered(tmp_path, 2)
    write_image(tmp_path / "0_thumb.png", 0, (10, 15))
    with pytest.raises(InputError, match=r"2 sizes: .*1 of 3 names look like .*0_thumb\.png.*--pattern"):
        open_source(tmp_path)


def test_cropping_keeps_the_centre(tmp_path: Path) -> None:
    image = np.arange(8 * 10 * 3, dtype=np.uint8).reshape(8, 10, 3)
    Image.fromarray(image).save(tmp_path / "0.png")
    Image.fromarray(image[:4, :6]).save(tmp_path / "1.png")
    frames = list(open_source(tmp_path, size_mismatch="crop"))
    np.testing.assert_array_equal(frames[0].image, image[2:6, 2:8])
    np.testing.assert_array_equal(frames[1].image, image[:4, :6])


def test_a_broken_picture_is_known_before_any_is_decoded(tmp_path: Path) -> None:
    write_numbered(tmp_path, 4, "jpg")
    truncate(tmp_path / "3.jpg")
    with pytest.raises(InputError, match=r"3\.jpg"):
        open_source(tmp_path, strict=True)
    source = open_source(tmp_path)
    assert len(source) == 3 and [skipped.name for skipped in source.skipped] == ["3"]
    assert len(source.notes) == 1 and re.search(r"left out: 1 broken .*3\.jpg", source.notes[0])


def test_a_picture_that_breaks_while_it_is_decoded_is_left_out_once(tmp_path: Path) -> None:
    write_numbered(tmp_path, 4)
    damage_pixels(tmp_path / "2.png")
    source = open_source(tmp_path)
    assert source.expected_frames == 4 and source.skipped == []
    assert [load() is None for load in source.loaders()] == [False, False, True, False]
    assert names(source) == ["0", "1", "3"]
    assert [skipped.name for skipped in source.skipped] == ["2"] and "2.png" in source.skipped[0].reason
    with pytest.raises(InputError, match=r"2\.png"):
        list(open_source(tmp_path, strict=True))


def test_what_is_left_out_is_listed_in_order_whichever_thread_is_first(tmp_path: Path) -> None:
    write_numbered(tmp_path, 60)
    for number in (4, 17, 29):
        damage_pixels(tmp_path / f"{number}.png")
    source = open_source(tmp_path)
    for load in reversed(list(source.loaders())):
        load()
    assert [skipped.name for skipped in source.skipped] == ["4", "17", "29"]


@pytest.mark.parametrize("damage", [truncate, damage_pixels])
def test_only_a_share_of_the_pictures_may_be_broken(tmp_path: Path, damage: Any) -> None:
    write_numbered(tmp_path, 40)
    for number in (3, 7):
        damage(tmp_path / f"{number}.png")
    assert len(list(open_source(tmp_path, most_broken=0.0))) == 38
    damage(tmp_path / "9.png")
    assert len(list(open_source(tmp_path, most_broken=0.1))) == 37
    with pytest.raises(InputError, match=r"3 of 40 images of .*3\.png.*7\.png.*9\.png"):
        list(open_source(tmp_path))


def test_a_folder_of_broken_pictures_alone_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").touch()
    with pytest.raises(InputError, match=r"no image of .* can be read.*a\.jpg: empty file"):
        open_source(tmp_path)


def test_pictures_that_change_after_the_source_was_opened_are_told(tmp_path: Path) -> None:
    write_numbered(tmp_path, 3)
    source = open_source(tmp_path)
    before = source.fingerprint(3)
    write_image(tmp_path / "1.png", 9, (24, 30))
    assert names(source) == ["0", "2"] and "was 30 x 20" in source.skipped[0].reason
    assert source.fingerprint(3) != before and source.fingerprint(0)
    (tmp_path / "0.png").unlink()
    with pytest.raises(MissingInput, match=r"0\.png was there when the source was opened"):
        list(source)
    with pytest.raises(MissingInput, match=r"0\.png|No such file"):
        source.fingerprint(3)


def test_the_fingerprint_covers_files_and_options(tmp_path: Path) -> None:
    write_numbered(tmp_path, 3)
    digests = [open_source(tmp_path, **options).fingerprint(2) for options in ({}, {"max_frames": 2}, {"stride": 2})]
    assert digests[0] == digests[1] != digests[2]
    write_image(tmp_path / "3.png", 3, (10, 10))
    cropped = [open_source(tmp_path, size_mismatch="crop", max_frames=n).fingerprint(2) for n in (3, 4)]
    assert cropped[0] != cropped[1], "the last picture makes the others smaller"
    (tmp_path / "3.png").unlink()
    assert open_source(tmp_path).fingerprint(2) == digests[0]
    os.utime(tmp_path / "1.png", (0, 0))
    assert open_source(tmp_path).fingerprint(2) != digests[0]


def test_heic_without_its_extra_is_left_out_with_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_numbered(tmp_path, 1)
    for name in ("1.HEIC", "2.HEIC", "3.jpg"):
        pillow_heif.from_pillow(Image.new("RGB", (30, 20))).save(tmp_path / "a.heic")
        (tmp_path / "a.heic").rename(tmp_path / name)
    assert len(list(open_source(tmp_path))) == 4
    monkeypatch.setitem(sys.modules, "pillow_heif.as_plugin", None)
    source = open_source(tmp_path)
    assert names(source) == ["0"] and source.skipped == []
    assert source.notes[0].startswith("2 .HEIC ignored: install logvggt-jax[heic]")
    assert source.notes[1].startswith("1 .jpg that are HEIC inside ignored")
    with pytest.raises(MissingPackage, match=r"1\.HEIC is HEIC"):
        open_source(tmp_path, strict=True)
    (tmp_path / "0.png").unlink()
    with pytest.raises(MissingPackage, match=r"install logvggt-jax\[heic\]"):
        open_source(tmp_path)


def test_pictures_that_look_all_around_are_told(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg"):
        xmp = b'<rdf:Description GPano:ProjectionType="equirectangular"/>' if name == "b.jpg" else b""
        Image.new("RGB", (40, 20)).save(tmp_path / name, xmp=xmp)
    (note,) = open_source(tmp_path).notes
    assert "look all around (equirectangular)" in note and note.count("jpg") == 1 and "b.jpg" in note


def test_files_of_several_pictures_are_told(tmp_path: Path) -> None:
    pages = [Image.new("RGB", (30, 20)), Image.new("RGB", (30, 20))]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:])
    burst = pillow_heif.HeifFile()
    for page in pages:
        burst.add_from_pillow(page)
    burst.save(tmp_path / "b.heic")
    assert "of which one is read: 2 (a.tif: 2, b.heic: 2)" in open_source(tmp_path).notes[0]


def test_names_that_no_result_could_have_are_refused(tmp_path: Path) -> None:
    for name, told in (("n" * 241, "241 bytes"), ("a\nb", "control characters")):
        write_image(tmp_path / "a.png", 1)
        (tmp_path / "a.png").rename(tmp_path / f"{name}.png")
        with pytest.raises(InputError, match=told):
            open_source(tmp_path)
        (tmp_path / f"{name}.png").unlink()
    write_image(tmp_path / "a.png", 1)
    (tmp_path / "a.png").rename(os.fsdecode(os.fsencode(tmp_path) + b"/\xff.png"))
    with pytest.raises(InputError, match="not UTF-8"):
        open_source(tmp_path)


def test_names_may_have_what_people_write(tmp_path: Path) -> None:
    for name in ("Küche 1", "台所: 2", "shot at 3.05\u202fPM"):
        Image.new("RGB", (30, 20)).save(tmp_path / f"{name}.png")
    assert set(names(open_source(tmp_path))) == {"Küche 1", "台所: 2", "shot at 3.05\u202fPM"}


def test_a_missing_permission_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_numbered(tmp_path, 2)
    original = Path.open

    def refusing(self: Path, *arguments: Any, **options: Any) -> Any:
        if self.name == "1.png":
            raise PermissionError(13, "Permission denied")
        return original(self, *arguments, **options)

    monkeypatch.setattr(Path, "open", refusing)
    with pytest.raises(DiskError, match=r"1\.png: Permission denied"):
        open_source(tmp_path)


@pytest.mark.parametrize(
    ("case", "options", "size", "count"),
    [
        ("photos_exif", {}, (240, 320), 4),
        ("photos_heic_and_jpg", {}, (240, 320), 6),
        ("png16", {}, (240, 320), 2),
        ("webp", {}, (240, 320), 3),
        ("rgb_and_masks", {"pattern": "*.jpg"}, (240, 320), 2),
        ("names_float_seconds", {}, (240, 320), 5),
        ("jpeg_odd_but_decodable", {}, (240, 320), 2),
        ("last_one_broken", {}, (240, 320), 4),
    ],
)
def test_pictures_as_users_have_them(
    cases_dir: Path, case: str, options: dict[str, Any], size: tuple[int, int], count: int
) -> None:
    source = open_source(cases_dir / case, **options)
    frames = list(source)
    assert source.image_size == size and source.expected_frames == len(frames) == count
    corners = np.array([[frame.image[y, x] for y in (5, -5) for x in (5, -5)] for frame in frames]).astype(int)
    truth = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]]
    assert np.abs(corners - truth).max() < 25


def test_depth_is_told_from_a_later_picture_where_the_first_is_blank(tmp_path: Path) -> None:
    depth = np.full((20, 30), 1500, np.uint16)
    depth[::3] = 0
    for number in range(6):
        assert cv2.imwrite(str(tmp_path / f"{number}.png"), depth * np.uint16(number > 0))
    with pytest.raises(InputError, match=r"\.png.*depth map"):
        open_source(tmp_path)


def test_a_folder_may_have_brackets_in_its_name(tmp_path: Path) -> None:
    folder = tmp_path / "photos [2020]"
    folder.mkdir()
    write_numbered(folder, 3)
    assert names(open_source(folder / "*.png")) == ["0", "1", "2"]


def test_several_lenses_are_told_and_the_median_is_noted(tmp_path: Path) -> None:
    for number, millimetres in enumerate((26, 26, 52, 78)):
        exif = Image.Exif()
        exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = millimetres
        Image.new("RGB", (84, 56), (number, 0, 0)).save(tmp_path / f"{number}.jpg", exif=exif)
    (note,) = (note for note in open_source(tmp_path).notes if "focal lengths" in note)
    assert re.fullmatch(
        r"images of several focal lengths by EXIF, \d\d to \d{3} pixels: no intrinsics are those of all", note
    )


def test_archives_and_an_end_before_the_beginning_are_named(tmp_path: Path) -> None:
    (tmp_path / "walk.zip").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"walk\.zip is an archive: unpack it"):
        open_source(tmp_path / "walk.zip")
    with pytest.raises(InputError, match=r"end must be above 0 s, got -5"):
        SourceOptions(end=-5.0)
    with pytest.raises(InputError, match="end must be finite: leave it out"):
        SourceOptions(end=float("inf"))
    for start in (-1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match=rf"start must be at least 0 s and finite, got {start} s"):
            SourceOptions(start=start)
