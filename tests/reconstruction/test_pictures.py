"""Every common format gives the upright picture, and what a header says is what the pixels are."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image, TiffImagePlugin
from tiff_by_hand import write_tiff

from logvggt_jax.data.errors import BrokenPicture
from logvggt_jax.errors import InputError, MissingPackage
from logvggt_jax.reconstruction.sources import headers
from logvggt_jax.reconstruction.sources.headers import read_header
from logvggt_jax.reconstruction.sources.pictures import read_picture

# Corners red, green / blue, yellow, as the scene has them.
SCENE = np.zeros((32, 48, 3), np.uint8)
SCENE[:16, :24], SCENE[:16, 24:] = (255, 0, 0), (0, 255, 0)
SCENE[16:, :24], SCENE[16:, 24:] = (0, 0, 255), (255, 255, 0)
# What a camera held otherwise stores, by orientation; each is the inverse of what the tag asks for.
STORED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda scene: scene,
    2: lambda scene: scene[:, ::-1],
    3: lambda scene: scene[::-1, ::-1],
    4: lambda scene: scene[::-1],
    5: lambda scene: scene.swapaxes(0, 1),
    6: lambda scene: np.rot90(scene, 1),
    7: lambda scene: np.rot90(scene, 2).swapaxes(0, 1),
    8: lambda scene: np.rot90(scene, -1),
}
FORMATS = ("jpg", "png", "webp", "tif", "avif")


def tags(orientation: int = 1, **camera: object) -> Image.Exif:
    exif = Image.Exif()
    exif[0x0112] = orientation
    names = {"length": 37386, "film": 41989, "resolution": 41486, "unit": 41488, "width": 40962, "taken": 36867}
    for name, value in camera.items():
        exif.get_ifd(0x8769)[names[name]] = value
    return exif


def read(path: Path) -> np.ndarray:
    header = read_header(path)
    image = read_picture(path, orientation=header.orientation)
    assert image.shape == (*header.size, 3) and image.dtype == np.uint8
    return image


def assert_is_scene(image: np.ndarray, tolerance: float = 12) -> None:
    assert image.shape == SCENE.shape
    assert np.abs(image.astype(int) - SCENE)[4:12, 4:20].mean() < tolerance
    assert np.abs(image.astype(int) - SCENE).mean() < tolerance


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", FORMATS)
def test_pictures_are_upright(tmp_path: Path, suffix: str, orientation: int) -> None:
    path = tmp_path / f"a.{suffix}"
    stored = np.ascontiguousarray(STORED[orientation](SCENE))
    options = {} if suffix in ("png", "tif") else {"quality": 95}
    Image.fromarray(stored).save(path, exif=tags(orientation), **options)
    assert_is_scene(read(path))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_heic_is_upright(tmp_path: Path, orientation: int) -> None:
    path = tmp_path / "a.heic"
    pillow_heif.register_heif_opener()
    stored = np.ascontiguousarray(STORED[orientation](SCENE))
    Image.fromarray(stored).save(path, quality=95, exif=tags(orientation).tobytes())
    assert_is_scene(read(path))


def test_orientation_of_a_png_may_follow_the_pixels(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(np.ascontiguousarray(STORED[6](SCENE))).save(path, exif=tags(6))
    data = path.read_bytes()
    start = data.index(b"eXIf") - 4
    end = start + 12 + int.from_bytes(data[start : start + 4], "big")
    path.write_bytes(data[:start] + data[end:-12] + data[start:end] + data[-12:])
    assert_is_scene(read(path))


@pytest.mark.parametrize("orientation", [0, 9, 300])
def test_orientations_that_do_not_exist_are_none(tmp_path: Path, orientation: int) -> None:
    Image.fromarray(SCENE).save(tmp_path / "a.png", exif=tags(orientation))
    assert_is_scene(read(tmp_path / "a.png"))


def test_damaged_camera_data_leave_the_picture_alone(tmp_path: Path) -> None:
    Image.fromarray(SCENE).save(tmp_path / "a.jpg", quality=95, exif=b"Exif\0\0II*\0\xff\xff\xff\xff" + b"\xff" * 40)
    assert_is_scene(read(tmp_path / "a.jpg"))


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_sixteen_bits_become_the_upper_eight(tmp_path: Path, suffix: str) -> None:
    deep = np.random.default_rng(0).integers(0, 65536, (20, 30, 3), np.uint16)
    deep[0, 0], deep[0, 1] = 65535, 255
    assert cv2.imwrite(str(tmp_path / f"a.{suffix}"), deep[..., ::-1])
    np.testing.assert_array_equal(read(tmp_path / f"a.{suffix}"), deep >> 8)
    assert cv2.imwrite(str(tmp_path / f"grey.{suffix}"), deep[..., 0])
    assert read_header(tmp_path / f"grey.{suffix}").deep_grey
    np.testing.assert_array_equal(read(tmp_path / f"grey.{suffix}"), (deep[..., :1] >> 8).repeat(3, 2))


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({262: 0}, "0 is white.*convert"),
        ({262: 2, 277: 3, 284: 2}, "planar.*convert"),
        ({259: 34712}, "not read.*34712.*convert it"),
    ],
)
def test_tiffs_that_decoders_read_wrong_or_not_are_told_what_they_are(
    tmp_path: Path, changed: dict[int, int], told: str
) -> None:
    with pytest.raises(InputError, match=rf"a\.tif.*{told}"):
        read_header(write_tiff(tmp_path / "a.tif", changed))


@pytest.mark.parametrize("mode", ["1", "L", "P", "CMYK"])
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "bmp"])
def test_other_kinds_of_colour_become_rgb(tmp_path: Path, suffix: str, mode: str) -> None:
    if mode == "CMYK" and suffix in ("png", "bmp"):
        suffix = "tif"
    if mode in ("1", "P") and suffix == "jpg":
        mode = "L"
    picture = Image.fromarray(SCENE).convert(mode)
    picture.save(tmp_path / f"a.{suffix}")
    expected = np.asarray(picture.convert("RGB")).astype(int)
    assert np.abs(read(tmp_path / f"a.{suffix}") - expected).mean() < 12


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_what_is_transparent_is_white(tmp_path: Path, mode: str) -> None:
    alpha = np.full((32, 48, 4), 100, np.uint8)
    alpha[:, :24, 3], alpha[:, 24:, 3] = 0, 255
    picture = Image.fromarray(alpha)
    if mode == "P":
        picture = picture.quantize(4)
    picture.convert(mode).save(tmp_path / "a.png")
    image = read(tmp_path / "a.png")
    assert (image[:, :24] == 255).all() and (image[:, 24:] == 100).all()


def test_alpha_that_is_nothing_throughout_is_meant_by_nobody(tmp_path: Path) -> None:
    Image.fromarray(np.dstack([SCENE, np.zeros((32, 48), np.uint8)])).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read(tmp_path / "a.png"), SCENE)


def test_the_content_decides_what_a_file_is(tmp_path: Path) -> None:
    Image.fromarray(SCENE).save(tmp_path / "a.webp", lossless=True)
    (tmp_path / "a.webp").rename(tmp_path / "a.jpg")
    np.testing.assert_array_equal(read(tmp_path / "a.jpg"), SCENE)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "empty file"),
        (b"GIF89a" + bytes(40), "is a GIF picture"),
        (b"\0\0\0\x18ftypmp42" + bytes(40), "is a video"),
        (b"<!DOCTYPE html>", "is a web page"),
        (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS pointer"),
        (b"hello there", "is no picture"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "damaged"),
        (b"\xff\xd8\xff\xe0" + bytes(100), "damaged"),
        (b"II*\0" + bytes(100), "damaged"),
        (b"BM" + bytes(100), "damaged"),
        (b"RIFF\x20\0\0\0WEBPVP8 " + bytes(100), "damaged"),
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(100), "damaged"),
        (b"\0\0\0\x18ftypavif\0\0\0\0mif1avif" + bytes(100), "damaged"),
    ],
)
def test_what_is_no_picture_is_named_as_what_it_is(tmp_path: Path, content: bytes, told: str) -> None:
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(BrokenPicture, match=rf"a\.jpg.*{told}"):
        read_header(tmp_path / "a.jpg")


@pytest.mark.parametrize("keep", [0.3, 0.7, 0.95])
@pytest.mark.parametrize("suffix", [*FORMATS, "bmp", "heic"])
def test_headers_tell_truncated_files(
    tmp_path: Path, suffix: str, keep: float, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"a.{suffix}"
    noise = Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8))
    if suffix == "heic":
        pillow_heif.from_pillow(noise).save(path)
    else:
        noise.save(path)
    read(path)
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(BrokenPicture, match=path.name):
        read_header(path)
    assert capfd.readouterr().err == ""


def test_a_flipped_byte_in_a_png_is_found_with_its_pixels(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)).save(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    read_header(path)
    with pytest.raises(BrokenPicture, match=r"a\.png.*checksum"):
        read_picture(path)


@pytest.mark.parametrize(
    "array", [np.ones((4, 4), np.float32), np.ones((4, 4), np.int32), np.ones((4, 4, 3), np.float32)]
)
def test_pixels_that_are_no_colours_are_said_to_be_depth(tmp_path: Path, array: np.ndarray) -> None:
    path = tmp_path / "a.tif"
    if array.ndim == 2:
        Image.fromarray(array).save(path)
    else:
        assert cv2.imwrite(str(path), array)
    with pytest.raises(InputError, match=r"a\.tif.*depth map"):
        read_header(path)


def test_a_gigapixel_is_refused_by_its_size(tmp_path: Path) -> None:
    path = tmp_path / "a.bmp"
    Image.new("1", (8, 8)).save(path)
    data = bytearray(path.read_bytes())
    data[18:26] = (40000).to_bytes(4, "little") + (30000).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.bmp is 40000 x 30000 pixels \(1,200 megapixels\)"):
        read_header(path)


def test_a_hundred_megapixels_draw_no_warning(tmp_path: Path) -> None:
    Image.new("1", (12000, 9000)).save(tmp_path / "a.png")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_header(tmp_path / "a.png").size == (9000, 12000)


def test_heic_without_its_extra_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pillow_heif.from_pillow(Image.fromarray(SCENE)).save(tmp_path / "a.heic")
    (tmp_path / "a.heic").rename(tmp_path / "a.jpg")
    assert_is_scene(read(tmp_path / "a.jpg"), 30)
    monkeypatch.setitem(sys.modules, "pillow_heif.as_plugin", None)
    with pytest.raises(MissingPackage, match=r"a\.jpg is HEIC: install logvggt-jax\[heic\]"):
        read_header(tmp_path / "a.jpg")


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        ({"film": 26}, 26 / np.hypot(36, 24) * np.hypot(32, 48)),
        # 10 mm, 100 pixels a millimetre of a picture that was 96 pixels wide: 1000 pixels, halved.
        ({"length": 10.0, "resolution": 1000.0, "unit": 3, "width": 96, "film": 99}, 500.0),
        ({"length": 10.0, "resolution": 2540.0, "unit": 2, "width": 48}, 1000.0),
        ({"length": 0.0, "film": 0}, None),
        ({}, None),
    ],
)
@pytest.mark.parametrize("orientation", [1, 6])
def test_focal_length_is_in_pixels(
    tmp_path: Path, camera: dict[str, object], expected: float | None, orientation: int
) -> None:
    values = {key: TiffImagePlugin.IFDRational(v) if isinstance(v, float) else v for key, v in camera.items()}
    Image.fromarray(SCENE).save(tmp_path / "a.jpg", exif=tags(orientation, **values))
    found = read_header(tmp_path / "a.jpg").focal_length
    assert found == (None if expected is None else pytest.approx(expected, rel=1e-4))


@pytest.mark.parametrize(
    ("noted", "expected"),
    [("2026:05:01 12:30:59", "2026:05:01 12:30:59"), ("0000:00:00 00:00:00", None), ("    :  :     :  :  ", None)],
)
def test_the_moment_is_the_cameras(tmp_path: Path, noted: str, expected: str | None) -> None:
    Image.fromarray(SCENE).save(tmp_path / "a.jpg", exif=tags(taken=noted))
    assert read_header(tmp_path / "a.jpg").taken == expected


def test_a_header_is_read_without_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for suffix in FORMATS:
        Image.fromarray(SCENE).save(tmp_path / f"a.{suffix}", exif=tags(6))
    with monkeypatch.context() as patch:
        patch.setattr(headers, "decode_jpeg", None)
        patch.setattr(Image.Image, "load", None)
        for suffix in FORMATS:
            assert read_header(tmp_path / f"a.{suffix}").size == (48, 32)
