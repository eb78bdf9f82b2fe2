"""Numbered files: numeric order, strays passed over, gaps named."""

import pickle
from pathlib import Path

import pytest

from logvggt_jax.data.errors import MissingFiles
from logvggt_jax.data.formats.numbered_files import numbered_files, numbered_frames, without_gaps
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.errors import InputError


def write(folder: Path, *names: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).touch()
    return folder


def test_order_is_numeric_and_strays_are_passed_over(tmp_path: Path):
    write(tmp_path, "img10.png", "img9.png", "img100.png", "img5.png.bak", "img.png", "ximg3.png", "img٣.png")
    found = numbered_files(SourceFiles(), tmp_path, "img{}.png")
    assert list(found.items()) == [(n, tmp_path / f"img{n}.png") for n in (9, 10, 100)]


def test_a_template_without_padding_takes_padded_names_and_two_of_one_number_are_named(tmp_path: Path):
    write(tmp_path, "000010.png", "000009.png", "11.png")
    found = numbered_files(SourceFiles(), tmp_path, "{}.png")
    assert [(number, path.name) for number, path in found.items()] == [
        (9, "000009.png"),
        (10, "000010.png"),
        (11, "11.png"),
    ]
    write(tmp_path, "9.png")
    with pytest.raises(InputError, match=r"/9\.png and 000009\.png have the same number"):
        numbered_files(SourceFiles(), tmp_path, "{}.png")


def test_padding_is_part_of_the_name(tmp_path: Path):
    write(tmp_path, "0001.png", "01.png", "2.png", "12345.png")
    assert list(numbered_files(SourceFiles(), tmp_path, "{:04d}.png")) == [1, 12345]


def test_a_frame_without_one_of_its_files_names_it(tmp_path: Path):
    colour, depth = write(tmp_path / "a", "1.jpg", "2.jpg"), write(tmp_path / "b", "1.png", "2.png")
    kinds = ((colour, "{}.jpg"), (depth, "{}.png"))
    assert list(numbered_frames(SourceFiles(), *kinds)) == [1, 2]
    write(depth, "3.png")
    with pytest.raises(FileNotFoundError, match=r"a/3\.jpg: no such file"):
        numbered_frames(SourceFiles(), *kinds)
    (depth / "1.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"b/1\.png: no such file \(nor 1 more\), but frame 1") as caught:
        numbered_frames(SourceFiles(), *kinds)
    # All of them, also where the error comes from a worker process.
    error = pickle.loads(pickle.dumps(caught.value))
    assert isinstance(error, MissingFiles) and str(error) == str(caught.value)
    assert list(error.reasons) == [depth / "1.png", colour / "3.jpg"]


def test_gaps_empty_and_absent_folders_are_named(tmp_path: Path):
    folder = write(tmp_path / "a", "2.png", "3.png", "5.png")
    frames = numbered_frames(SourceFiles(), (folder, "{}.png"))
    with pytest.raises(FileNotFoundError, match="a: frame 4 is missing"):
        without_gaps(frames)
    del frames[5]
    assert without_gaps(frames) == [(folder / "2.png",), (folder / "3.png",)]
    with pytest.raises(FileNotFoundError, match=r"b: no files like 0\.png"):
        numbered_files(SourceFiles(), write(tmp_path / "b"), "{}.png")
    with pytest.raises(FileNotFoundError, match="c: no such folder"):
        numbered_files(SourceFiles(), tmp_path / "c", "{}.png")
