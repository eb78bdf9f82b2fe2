"""Folders and text files of a data set: what the operating system refuses to show is told of."""

from pathlib import Path

import pytest
from absl import logging

from logvggt_jax.data.formats.source_files import SourceFiles


def test_a_folder_without_permission_is_passed_over_with_a_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "apple").mkdir()
    (tmp_path / "apple/list.txt").touch()
    messages: list[str] = []
    monkeypatch.setattr(logging, "warning", lambda text, *values: messages.append(text % values))
    files, stat = SourceFiles(), Path.stat
    assert files.exists(tmp_path / "apple/list.txt") and not files.exists(tmp_path / "pear/list.txt") and not messages

    def denied(self: Path, **others):  # the superuser, who may run this, is denied nothing
        if self.parent.name == "apple":
            raise PermissionError(13, "Permission denied", str(self))
        return stat(self, **others)

    monkeypatch.setattr(Path, "stat", denied)
    assert not files.exists(tmp_path / "apple/list.txt")
    assert messages == [f"{tmp_path / 'apple'}: Permission denied: nothing in it counts"]
