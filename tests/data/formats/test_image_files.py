"""Whole pictures are read as they are; truncated, damaged and mistyped ones are named."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from tiff_by_hand import write_tiff

from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.errors import InputError

PICTURE = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
DEPTH = np.random.default_rng(1).integers(0, 65536, (40, 60), np.uint16)


def write(path: Path, array: np.ndarray, *parameters: int) -> Path:
    assert cv2.imwrite(str(path), array, list(parameters))
    return path


@pytest.mark.parametrize("suffix", ["png", "bmp"])
def test_lossless_pictures_come_back_in_rgb(tmp_path: Path, suffix: str):
    assert np.array_equal(read_rgb(write(tmp_path / f"a.{suffix}", PICTURE[..., ::-1])), PICTURE)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(("suffix", "lossless"), [("jpg", {"quality": 100}), ("png", {}), ("webp", {"lossless": True})])
def test_pixels_are_as_stored_whatever_orientation_the_camera_notes(
    tmp_path: Path, orientation: int, suffix: str, lossless: dict
):
    noted = Image.Exif()
    noted[0x112] = orientation
    flat = np.full((40, 60, 3), 200, np.uint8)
    flat[:20, :30] = 30
    Image.fromarray(flat).save(tmp_path / f"a.{suffix}", exif=noted, **lossless)
    assert np.abs(read_rgb(tmp_path / f"a.{suffix}").astype(int) - flat).max() < 8
    Image.fromarray(PICTURE).save(tmp_path / "a.tif", tiffinfo={0x112: orientation})
    assert np.array_equal(read_rgb(tmp_path / "a.tif"), PICTURE)
    Image.fromarray(DEPTH).save(tmp_path / "d.tif", tiffinfo={0x112: orientation})
    assert np.array_equal(read_depth(tmp_path / "d.tif"), DEPTH)


@pytest.mark.parametrize("progressive", [0, 1])
def test_jpeg_pictures_come_back_in_rgb(tmp_path: Path, progressive: int):
    smooth = cv2.GaussianBlur(PICTURE, (0, 0), 5)
    path = write(
        tmp_path / "a.jpg",
        smooth[..., ::-1],
        cv2.IMWRITE_JPEG_QUALITY,
        98,
        cv2.IMWRITE_JPEG_PROGRESSIVE,
        progressive,
        cv2.IMWRITE_JPEG_RST_INTERVAL,
        2,
    )
    assert np.abs(read_rgb(path).astype(int) - smooth).mean() < 2


def test_grey_is_repeated_and_alpha_is_composited_over_white(tmp_path: Path):
    grey = read_rgb(write(tmp_path / "grey.png", PICTURE[..., 0]))
    assert np.array_equal(grey, PICTURE[..., :1].repeat(3, 2))
    alpha = np.dstack([PICTURE[..., ::-1], np.where(np.arange(60) < 30, 0, 255) * np.ones((40, 1))]).astype(np.uint8)
    composited = read_rgb(write(tmp_path / "alpha.png", alpha))
    assert (composited[:, :30] == 255).all() and np.array_equal(composited[:, 30:], PICTURE[:, 30:])
    nothing = np.dstack([PICTURE[..., ::-1], np.zeros((40, 60), np.uint8)])
    assert np.array_equal(read_rgb(write(tmp_path / "nothing.png", nothing)), PICTURE)


def test_depth_keeps_its_sixteen_bits(tmp_path: Path):
    assert np.array_equal(read_depth(write(tmp_path / "d.png", DEPTH)), DEPTH)


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_sixteen_bits_become_the_upper_eight(tmp_path: Path, suffix: str):
    deep = np.random.default_rng(0).integers(0, 65536, (40, 60, 4), np.uint16)
    deep[0, 0], deep[..., 3] = (65535, 255, 256, 0), 65535
    assert np.array_equal(read_rgb(write(tmp_path / f"rgb.{suffix}", deep[..., 2::-1])), deep[..., :3] >> 8)
    assert np.array_equal(read_rgb(write(tmp_path / f"rgba.{suffix}", deep[..., [2, 1, 0, 3]])), deep[..., :3] >> 8)
    assert np.array_equal(read_rgb(write(tmp_path / f"grey.{suffix}", DEPTH)), (DEPTH[..., None] >> 8).repeat(3, 2))


@pytest.mark.parametrize(("changed", "told"), [({262: 0}, "0 is white"), ({262: 2, 277: 3, 284: 2}, "planar")])
def test_a_tiff_that_opencv_would_read_wrong_is_refused(tmp_path: Path, changed: dict[int, int], told: str):
    with pytest.raises(InputError, match=rf"a\.tif: .*{told}.* convert it to PNG"):
        read_rgb(write_tiff(tmp_path / "a.tif", changed))


def test_depth_in_the_place_of_colour_is_named(tmp_path: Path):
    with pytest.raises(ValueError, match=r"d\.png.*look like depth"):
        read_rgb(write(tmp_path / "d.png", DEPTH // 16))
    with pytest.raises(ValueError, match=r"t\.tif.*look like depth"):
        read_rgb(write(tmp_path / "t.tif", DEPTH // 16))
    with pytest.raises(ValueError, match=r"signed\.tif.*int16"):
        read_rgb(write(tmp_path / "signed.tif", (DEPTH // 16).astype(np.int16)))


@pytest.mark.parametrize("keep", [0.0, 0.05, 0.3, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_truncated_pictures_are_named(tmp_path: Path, suffix: str, keep: float):
    path = write(tmp_path / f"cut.{suffix}", PICTURE)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(ValueError, match=rf"cut\.{suffix}.*fetch it again"):
        read_rgb(path)


def test_truncated_depth_is_named(tmp_path: Path):
    path = write(tmp_path / "cut.png", DEPTH)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ValueError, match=r"cut\.png.*fetch it again"):
        read_depth(path)


def test_a_jpeg_with_a_whole_thumbnail_but_half_a_picture_is_truncated(tmp_path: Path):
    whole = write(tmp_path / "a.jpg", PICTURE).read_bytes()
    thumbnail = write(tmp_path / "b.jpg", PICTURE[::4, ::4]).read_bytes()
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    path = tmp_path / "c.jpg"
    path.write_bytes(whole[:2] + segment + whole[2:])
    assert np.array_equal(read_rgb(path), read_rgb(tmp_path / "a.jpg"))
    path.write_bytes(whole[:2] + segment + whole[2 : len(whole) // 2])
    with pytest.raises(ValueError, match=r"c\.jpg"):
        read_rgb(path)


def jpeg(path: Path, mode: str = "RGB", **options: object) -> bytes:
    Image.fromarray(cv2.GaussianBlur(PICTURE, (0, 0), 3)).convert(mode).save(path, "JPEG", quality=95, **options)
    return path.read_bytes()


def after_the_tables(data: bytes) -> int:
    return data.index(b"\xff\xc4")


@pytest.mark.parametrize("progressive", [False, True])
@pytest.mark.parametrize(
    "odd",
    [
        lambda data: data[:-2],
        lambda data: data[:-1],
        lambda data: data + b"\0" * 5000,
        lambda data: data + b"camera maker's own \xff\xd8\xff\xe0 data",
        lambda data: data[: after_the_tables(data)] + b"stray" + data[after_the_tables(data) :],
    ],
    ids=["no end", "half an end", "padded", "trailing data", "stray bytes"],
)
def test_a_jpeg_that_is_odd_but_whole_is_read_in_silence(
    tmp_path: Path, odd: Callable[[bytes], bytes], progressive: bool, capfd: pytest.CaptureFixture[str]
):
    path = tmp_path / "a.jpg"
    data = jpeg(path, progressive=progressive)
    expected = read_rgb(path)
    path.write_bytes(odd(data))
    np.testing.assert_array_equal(read_rgb(path), expected)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("keep", [0.2, 0.5, 0.8, 0.99])
@pytest.mark.parametrize("tail", [b"", b"\0" * 4000, b"\xff"], ids=["cut", "zeros", "half a marker"])
@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_without_its_end_is_refused_where_pixels_are_missing(
    tmp_path: Path, keep: float, tail: bytes, progressive: bool
):
    path = tmp_path / "cut.jpg"
    data = jpeg(path, progressive=progressive)
    start = data.index(b"\xff\xda")
    path.write_bytes(data[: start + int(keep * (len(data) - start))] + tail)
    with pytest.raises(ValueError, match=r"cut\.jpg.*fetch it again"):
        read_rgb(path)


@pytest.mark.parametrize("keep", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("lost", [0, 1], ids=["cut", "zeros"])
@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_with_its_end_is_refused_where_pixels_are_missing(
    tmp_path: Path, keep: float, lost: int, progressive: bool
):
    path = tmp_path / "cut.jpg"
    picture = np.tile(cv2.GaussianBlur(PICTURE, (0, 0), 3), (3, 3, 1))
    Image.fromarray(picture).save(path, quality=95, progressive=progressive)
    data = path.read_bytes()
    start, end = data.index(b"\xff\xda"), len(data) - 2
    cut = start + int(keep * (end - start))
    path.write_bytes(data[:cut] + bytes(lost * (end - cut)) + data[end:])
    with pytest.raises(ValueError, match=r"cut\.jpg.*fetch it again"):
        read_rgb(path)


def test_a_jpeg_that_was_written_with_fewer_scans_is_whole(tmp_path: Path):
    """Servers leave the last ones out to save bytes: it is coarser, and nothing is missing."""
    path = tmp_path / "a.jpg"
    data = jpeg(path, progressive=True)
    path.write_bytes(data[: data.rindex(b"\xff\xda")] + b"\xff\xd9")
    assert np.abs(read_rgb(path).astype(int) - cv2.GaussianBlur(PICTURE, (0, 0), 3)).mean() < 4


@pytest.mark.parametrize("subsampling", [0, 2])
@pytest.mark.parametrize("place", [0.2, 0.5, 0.8])
def test_a_jpeg_of_which_a_part_is_zeros_is_refused(tmp_path: Path, place: float, subsampling: int):
    """Where the decoder finds its way again the end of the picture tells nothing."""
    path = tmp_path / "lost.jpg"
    Image.fromarray(np.tile(PICTURE, (4, 4, 1))).save(path, quality=95, subsampling=subsampling)
    data = bytearray(path.read_bytes())
    start = data.index(b"\xff\xda")
    begin = start + int(place * (len(data) - start))
    data[begin : begin + 512] = bytes(512)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"lost\.jpg.*fetch it again"):
        read_rgb(path)


def test_a_jpeg_with_a_large_area_of_one_colour_is_whole(tmp_path: Path):
    flat = np.full((320, 480, 3), 200, np.uint8)
    flat[:8, -8:] = 0
    Image.fromarray(flat).save(tmp_path / "a.jpg", quality=95, optimize=True)
    assert bytes(256) in (tmp_path / "a.jpg").read_bytes()
    assert (read_rgb(tmp_path / "a.jpg")[0, 0] == 200).all()


@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_whose_corner_is_of_one_colour_is_whole(tmp_path: Path, progressive: bool):
    flat = PICTURE.copy()
    flat[16:, 32:] = 128
    Image.fromarray(flat).save(tmp_path / "a.jpg", quality=95, progressive=progressive)
    assert (read_rgb(tmp_path / "a.jpg")[-1, -1] == 128).all()


def test_a_jpeg_for_print_becomes_rgb(tmp_path: Path):
    path = tmp_path / "cmyk.jpg"
    jpeg(path, "CMYK")
    assert np.abs(read_rgb(path).astype(int) - cv2.GaussianBlur(PICTURE, (0, 0), 3)).mean() < 3


def test_data_sets_keep_pixels_as_stored(tmp_path: Path):
    exif = Image.Exif()
    exif[0x0112] = 6
    jpeg(tmp_path / "a.jpg", exif=exif)
    assert read_rgb(tmp_path / "a.jpg").shape == PICTURE.shape


def test_a_flipped_byte_in_a_png_is_named(tmp_path: Path):
    path = write(tmp_path / "flipped.png", PICTURE)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"flipped\.png"):
        read_rgb(path)


def test_what_is_no_picture_is_named(tmp_path: Path):
    path = tmp_path / "text.png"
    path.write_text("not a picture")
    with pytest.raises(ValueError, match=r"text\.png"):
        read_rgb(path)
    with pytest.raises(FileNotFoundError, match=r"absent\.png"):
        read_rgb(tmp_path / "absent.png")
    for content, told in (
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(100), "HEIC inside: convert it to JPEG"),
        (b"version https://git-lfs.github.com/spec/v1\n", "no picture but a Git LFS pointer"),
        (b"<!DOCTYPE html>", "no picture but a web page"),
        (b"BM" + bytes(100), "damaged, or a BMP of a kind"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"text\.png: {told}"):
            read_rgb(path)


def test_wrong_types_are_named(tmp_path: Path):
    with pytest.raises(ValueError, match=r"shallow\.png.*uint8"):
        read_depth(write(tmp_path / "shallow.png", PICTURE[..., 0]))
