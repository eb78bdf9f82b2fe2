"""Files and folders appear whole or not at all, whatever happens while they are written."""

import errno
import os
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from logvggt_jax.errors import DiskError, InputError, MissingInput, OutputExists, one_line, printable
from logvggt_jax.files import (
    FolderKind,
    atomic_file,
    atomic_folder,
    check_output,
    numpy_reading,
    open_regular,
    user_path,
    write_text,
)

DONE = FolderKind("done", ("done", "frame-*"))


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_a_file_appears_whole_or_not_at_all(tmp_path: Path, failure: type[BaseException]) -> None:
    path = tmp_path / "f.txt"
    write_text(path, "old")
    with pytest.raises(failure), atomic_file(path) as temporary:
        temporary.write_text("half")
        raise failure
    assert path.read_text() == "old" and names(tmp_path) == ["f.txt"]


def test_two_writers_of_one_file_do_not_meet(tmp_path: Path) -> None:
    path = tmp_path / "picture.png"
    with atomic_file(path) as first, atomic_file(path) as second:
        assert first != second and first.suffix == second.suffix == ".png"
        second.write_text("second")
        first.write_text("first")
    assert path.read_text() == "first" and names(tmp_path) == ["picture.png"]


def test_what_the_disk_refuses_is_one_line_that_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(MissingInput, match=r"^\S+nowhere/f\.txt: No such file or directory$"):
        write_text(tmp_path / "nowhere" / "f.txt", "")
    with pytest.raises(DiskError, match=r"^\S+f\.txt: No space left on device$"), atomic_file(tmp_path / "f.txt"):
        raise OSError(errno.ENOSPC, "No space left on device")
    (tmp_path / "file").touch()
    with (
        pytest.raises(DiskError, match=r"file/deep/out\.\S+partial: Not a directory"),
        atomic_folder(tmp_path / "file" / "deep" / "out"),
    ):
        pass
    assert names(tmp_path) == ["file"]


def test_a_name_that_the_disk_refuses_is_one_line_too(tmp_path: Path) -> None:
    """The temporary name cannot be removed either where there can be none."""
    with pytest.raises(DiskError, match=r"file/f\.txt: Not a directory$"):
        (tmp_path / "file").touch()
        write_text(tmp_path / "file" / "f.txt", "")
    with pytest.raises(DiskError, match=r"nnn\.txt: File name too long$"):
        write_text(tmp_path / (300 * "n" + ".txt"), "")


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "file").write_text("content")
    for name in ("pipe", "."):
        with (
            pytest.raises(InputError, match="is no file but a folder, a pipe or a device"),
            open_regular(tmp_path / name),
        ):
            pass
    with pytest.raises(MissingInput, match="nothing: No such file"), open_regular(tmp_path / "nothing"):
        pass
    with pytest.raises(DiskError, match="loop: Too many levels of symbolic links"), open_regular(tmp_path / "loop"):
        pass
    with open_regular(tmp_path / "file") as stream:
        assert stream.read() == b"content"
    # Python 3.13 resolves such a path without complaint.
    with (
        pytest.raises(InputError, match="loop"),
        atomic_folder(check_output(tmp_path / "loop" / "out", overwrite=True, kind=DONE)),
    ):
        pass


def test_control_characters_are_shown_and_not_obeyed() -> None:
    assert printable("naïve 写真 a.jpg") == "naïve 写真 a.jpg"
    assert printable("a\x1b[31m\x9b\x07\u202egnp.\u2028") == r"a\x1b[31m\x9b\x07\u202egnp.\u2028"
    assert printable(os.fsdecode(b"caf\xe9")) == r"caf\xe9"
    assert one_line(InputError("a\x1b[2J\nis   missing")) == r"a\x1b[2J is missing"
    assert one_line(InputError("")) == "InputError"


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "out"
    with pytest.raises(KeyboardInterrupt), atomic_folder(target) as folder:
        (folder / "done").touch()
        raise KeyboardInterrupt
    assert names(tmp_path / "deep") == []
    with atomic_folder(target) as folder:
        assert not target.exists()
        (folder / "done").write_text("1")
    assert (target / "done").read_text() == "1" and names(tmp_path / "deep") == ["out"]


def test_only_results_are_overwritten_and_only_when_asked(tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.mkdir()
    (target / "thesis.tex").write_text("years of work")
    for overwrite in (False, True):
        with pytest.raises(OutputExists, match=str(target)):
            check_output(target, overwrite=overwrite, kind=DONE)
    (tmp_path / "file").touch()
    with pytest.raises(OutputExists, match="it holds no done, so it is no earlier result"):
        check_output(tmp_path / "file", overwrite=True, kind=DONE)
    (tmp_path / "file").unlink()
    (target / "done").touch()
    with pytest.raises(OutputExists, match=r"out is not overwritten: thesis\.tex in it is not of an earlier result"):
        check_output(target, overwrite=True, kind=DONE)
    (target / "thesis.aux").touch()
    with pytest.raises(OutputExists, match=r"thesis\.aux and 1 more in it"):
        check_output(target, overwrite=True, kind=DONE)
    for name in ("thesis.aux", "thesis.tex"):
        (target / name).unlink()
    for name in ("frame-000001", ".DS_Store", "._done"):
        (target / name).touch()
    assert check_output(target, overwrite=True, kind=DONE) == target
    with pytest.raises(OutputExists, match="--overwrite"), atomic_folder(target):
        pass
    with pytest.raises(RuntimeError), atomic_folder(target, replace=True):
        raise RuntimeError
    assert (target / "done").exists()
    with atomic_folder(target, replace=True) as folder:
        (folder / "new").touch()
    assert names(target) == ["new"] and names(tmp_path) == ["out"]


def test_an_empty_folder_is_as_good_as_none(tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.mkdir()
    assert check_output(target, overwrite=False, kind=DONE) == target
    with atomic_folder(target) as folder:
        (folder / "done").touch()
    assert names(target) == ["done"] and names(tmp_path) == ["out"]
    with pytest.raises(OutputExists, match="--overwrite"):
        check_output(target, overwrite=False, kind=DONE)


def test_the_top_of_a_volume_is_told_before_the_work_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a folder that a container gets from outside: nothing can be renamed to it."""
    monkeypatch.setattr(Path, "is_mount", lambda self: self == tmp_path)
    for overwrite in (False, True):
        with pytest.raises(OutputExists, match="top of a volume"):
            check_output(tmp_path, overwrite=overwrite, kind=DONE)
    assert check_output(tmp_path, overwrite=True, kind=DONE, in_place=True) == tmp_path
    assert check_output(tmp_path / "new", overwrite=False, kind=DONE) == tmp_path / "new"


def test_a_folder_that_cannot_be_replaced_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "out"
    target.mkdir()
    (target / "done").write_text("old")
    original = Path.rename

    def refuse(self: Path, new: Path) -> Path:
        if self.suffix == ".partial":
            raise PermissionError(errno.EACCES, "in use")
        return original(self, new)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(DiskError, match="out: in use"), atomic_folder(target, replace=True) as folder:
        (folder / "done").write_text("new")
    assert (target / "done").read_text() == "old" and names(tmp_path) == ["out"]


def test_of_two_runs_the_second_to_end_leaves_the_first_result(tmp_path: Path) -> None:
    target = tmp_path / "out"
    with pytest.raises(OutputExists, match="out exists"), atomic_folder(target) as second:
        (second / "done").write_text("second")
        with atomic_folder(target) as first:
            (first / "done").write_text("first")
    assert (target / "done").read_text() == "first" and names(tmp_path) == ["out"]


def test_a_name_of_the_longest_kind_can_be_written(tmp_path: Path) -> None:
    for name in (f"{'n' * 251}.txt", f"{'é' * 125}.json", f"x.{'y' * 248}"):
        with atomic_file(tmp_path / name) as temporary:
            temporary.write_text("whole")
            assert temporary.name.startswith(f".{name[:1]}") and len(temporary.name.encode()) <= 255
        assert (tmp_path / name).read_text() == "whole"
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize("resolved", [False, True])
def test_paths_that_are_none_are_one_line(tmp_path: Path, resolved: bool) -> None:
    with pytest.raises(InputError, match="the path is empty"):
        user_path(" ", resolved=resolved)
    with pytest.raises(InputError, match=r"~nobody-of-this-name/x: .*home directory"):
        user_path("~nobody-of-this-name/x", resolved=resolved)
    (tmp_path / "loop").symlink_to("loop")
    if resolved:
        with pytest.raises(InputError, match="loop"):
            user_path(tmp_path / "loop", resolved=True)


def test_an_array_file_with_any_damaged_byte_is_read_or_a_value_error(tmp_path: Path) -> None:
    """NumPy leaves a header that it does not understand to Python's tokens, whose errors are none of its own."""
    path, other = tmp_path / "a.npy", set()
    np.save(path, np.zeros((3, 4)))
    whole = path.read_bytes()
    for place, byte in product(range(128), (0, ord("("), ord("'"), 255)):
        path.write_bytes(whole[:place] + bytes([byte]) + whole[place + 1 :])
        try:
            np.load(path, allow_pickle=False)
        except Exception as error:
            other.add(type(error))
            with pytest.raises(ValueError), numpy_reading():
                np.load(path, allow_pickle=False)
    assert any(not issubclass(kind, ValueError) for kind in other)


def test_missing_array_files_stay_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), numpy_reading():
        np.load(tmp_path / "none.npy")
