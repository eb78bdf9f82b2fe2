"""The index of listings: a second start lists nothing, every change of the folder is seen, damage costs time only."""

import importlib
import os
import sqlite3
import sys
from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest
from absl import logging
from layouts import tum_recording
from layouts.layout import VIEWS
from layouts.replica import write, write_camera, write_scene

from logvggt_jax.data import open_dataset
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers import folder_dataset
from logvggt_jax.data.readers.listing_index import ListingIndex, code_digest
from logvggt_jax.data.readers.replica import Replica
from logvggt_jax.errors import InputError


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene of three frames that has not changed for an hour, and a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "replica"
    write(folder, VIEWS[:3])
    # Clocks of file systems tick slowly: a change now differs from one an hour ago in any case.
    for path in (folder, *folder.rglob("*")):
        before = path.stat().st_mtime - 3600
        os.utime(path, (before, before))
    return folder


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often folders were listed and text files read."""
    counts: Counter[str] = Counter()
    for name in ("names", "content"):
        original = getattr(SourceFiles, name)

        def counted(self, path: Path, expected: str, name=name, original=original):
            counts[name] += 1
            return original(self, path, expected)

        monkeypatch.setattr(SourceFiles, name, counted)
    return counts


@pytest.fixture
def warnings_of(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    messages: list[str] = []
    monkeypatch.setattr(logging, "warning", lambda text, *values: messages.append(text % values))
    monkeypatch.setattr(logging, "log_first_n", lambda _, text, __, *values: messages.append(text % values))
    return messages


def index_file(root: Path) -> Path:
    (path,) = (root.parent / "cache/logvggt/listings").iterdir()
    return path


def names(root: Path) -> list[str]:
    replica = Replica(root)
    assert replica.num_frames("room0") == len(replica.frame_names("room0"))
    return replica.frame_names("room0")


ALL = [f"frame{i:06d}" for i in range(3)]


def test_the_second_start_reads_nothing_and_gives_the_same(root: Path, reads: Counter[str]):
    first = Replica(root)
    expected = first.read("room0", [0, 1, 2])
    assert reads["names"] >= 2 and reads["content"] >= 2
    reads.clear()
    second = Replica(root)
    assert second.sequences == first.sequences and second.num_frames("room0") == 3
    assert second.frame_names("room0") == ALL and second.dropped_frames("room0") == {}
    frames = second.read("room0", [0, 1, 2])
    assert not reads
    for name in ("images", "depth", "intrinsics", "extrinsics"):
        assert (getattr(frames, name) == getattr(expected, name)).all()


@pytest.mark.parametrize("absolute", [True, False])
def test_files_that_lists_name_outside_of_a_linked_root_are_found_again(tmp_path: Path, absolute: bool):
    tum_recording.write(tmp_path / "far/away/set", tum_recording.LAYOUT.views)
    recording = tmp_path / "far/away/set" / tum_recording.NAME
    (recording / "rgb").rename(tmp_path / "far/away/pictures")
    listing = recording / "rgb.txt"
    place = tmp_path / "far/away/pictures" if absolute else "../../pictures"
    listing.write_text(listing.read_text().replace("rgb/", f"{place}/"))
    (tmp_path / "here/in").mkdir(parents=True)
    (tmp_path / "here/in" / recording.name).symlink_to(recording)
    (tmp_path / "set").symlink_to(tmp_path / "here/in")
    for _ in range(2):  # listed, then from the index
        assert len(open_dataset("tum_recording", tmp_path / "set").read(recording.name, [0, 1]).images) == 2


def test_an_open_set_looks_at_its_files_once(root: Path, monkeypatch: pytest.MonkeyPatch):
    """However often a listing leaves memory and is read again, and with one question to the file system a file."""
    names(root)
    monkeypatch.setattr(folder_dataset, "_RECENT", 0)
    asked: Counter[Path] = Counter()
    original = Path.stat

    def counted(path: Path, **options: bool) -> os.stat_result:
        asked[path] += 1
        return original(path, **options)

    replica = Replica(root)
    monkeypatch.setattr(Path, "stat", counted)
    assert replica.num_frames("room0") == 3 and replica.frame_names("room0") == ALL
    sources = {path: count for path, count in asked.items() if path.is_relative_to(root)}
    assert sources and set(sources.values()) == {1}
    for _ in range(3):
        replica.read("room0", [0, 2])
    again = {path: count for path, count in asked.items() if path in sources}
    assert again == sources


def test_files_added_and_removed_are_seen(root: Path):
    assert names(root) == ALL
    poses = (root / "room0/traj.txt").read_text()
    for kind in ("frame{}.jpg", "depth{}.png"):
        path = root / "room0/results" / kind.format("000003")
        path.write_bytes((root / "room0/results" / kind.format("000002")).read_bytes())
    (root / "room0/traj.txt").write_text(poses + poses.splitlines()[2] + "\n")
    assert names(root) == [*ALL, "frame000003"]
    (root / "room0/results/depth000003.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"depth000003\.png"):
        names(root)
    (root / "room0/results/frame000003.jpg").unlink()
    (root / "room0/traj.txt").write_text(poses)
    assert names(root) == ALL


def test_sequences_added_and_removed_are_seen(root: Path):
    assert Replica(root).sequences == ("room0",)
    (root / "room0").rename(root / "room1")
    assert Replica(root).sequences == ("room1",)
    write_scene(root / "room2", VIEWS[:1])
    assert Replica(root).sequences == ("room1", "room2")


def test_names_that_are_no_unicode_are_listed(root: Path, reads: Counter[str]):
    (root / "room0").rename(root / os.fsdecode(b"k\xfcche"))
    (name,) = Replica(root).sequences
    assert Replica(root).num_frames(name) == 3
    reads.clear()
    assert Replica(root).num_frames(name) == 3 and not reads


def test_an_edited_calibration_and_pose_are_seen(root: Path):
    before = Replica(root).read("room0", [0])
    write_camera(root, fx=50.0)
    after = Replica(root).read("room0", [0])
    assert after.intrinsics[0, 0, 0] == 50 and before.intrinsics[0, 0, 0] == pytest.approx(55)
    (root / "cam_params.json").unlink()
    with pytest.raises(InputError, match="64 x 48 does not have the shape"):  # of the rendering's own camera
        Replica(root).read("room0", [0])
    lines = (root / "room0/traj.txt").read_text().splitlines()
    (root / "room0/traj.txt").write_text("\n".join([lines[1], *lines[1:]]))
    replica = Replica(root)
    assert (replica.extrinsics("room0")[0] == replica.extrinsics("room0")[1]).all()


def test_a_file_that_is_no_index_is_made_anew(root: Path, reads: Counter[str], warnings_of: list[str]):
    assert names(root) == ALL
    index_file(root).write_bytes(b"this is no database" * 100)
    assert names(root) == ALL
    assert len(warnings_of) == 1 and "made anew" in warnings_of[0] and str(index_file(root)) in warnings_of[0]
    reads.clear()
    assert names(root) == ALL and not reads and len(warnings_of) == 1


@pytest.mark.parametrize("damage", [b"", b"not an archive", None])
def test_a_damaged_listing_is_made_anew(root: Path, reads: Counter[str], warnings_of: list[str], damage: bytes | None):
    assert names(root) == ALL
    with closing(sqlite3.connect(index_file(root))) as connection, connection:
        (payload,) = connection.execute("SELECT payload FROM listings WHERE key = 'frames room0'").fetchone()
        broken = payload[:300] + b"\xff\x00\xff" + payload[303:] if damage is None else damage
        connection.execute("UPDATE listings SET payload = ? WHERE key = 'frames room0'", (broken,))
    assert names(root) == ALL and len(warnings_of) == 1 and "made anew" in warnings_of[0]
    reads.clear()
    assert names(root) == ALL and not reads


def test_a_cache_folder_that_cannot_be_written_only_warns(root: Path, warnings_of: list[str]):
    (root.parent / "cache").write_text("a file where the folder should be")
    for _ in range(2):
        assert names(root) == ALL
    assert warnings_of and "not kept" in warnings_of[0]


def test_copies_and_readers_do_not_share_an_index(root: Path):
    other = root.parent / "other"
    write_scene(other / "room0", VIEWS[:2])
    assert names(root) == ALL and names(other) == ALL[:2] and names(root) == ALL
    identities = ({"name": "replica"}, {"name": "nrgbd"}, {"name": "replica", "upright": False})
    paths = {ListingIndex(identity, folder, "code").path for identity in identities for folder in (root, other)}
    assert len(paths) == 6
    # However the folder is spelt.
    assert ListingIndex(identities[0], root / ".." / root.name, "code").path in paths


READER = """
from logvggt_jax.data.readers.replica import Replica

class Renamed(Replica):
    def _frames(self, sequence, folder, files):
        for number, record in enumerate(super()._frames(sequence, folder, files)):
            yield dataclasses.replace(record, name=f"PREFIX{number}")

import dataclasses
"""


def test_a_changed_reader_lists_anew_and_an_unchanged_one_does_not(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reads: Counter[str]
):
    monkeypatch.syspath_prepend(tmp_path / "code")
    source = tmp_path / "code" / "a_changing_reader.py"
    source.parent.mkdir()

    def names_with(prefix: str) -> list[str]:
        source.write_text(READER.replace("PREFIX", prefix))
        sys.modules.pop("a_changing_reader", None)
        importlib.invalidate_caches()
        return importlib.import_module("a_changing_reader").Renamed(root).frame_names("room0")

    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    assert names_with("old") == ["old0", "old1", "old2"]
    reads.clear()
    assert names_with("old") == ["old0", "old1", "old2"] and not reads
    assert names_with("new") == ["new0", "new1", "new2"] and reads
    assert index_file(root)  # the old listing has been replaced


def test_the_digest_knows_the_modules_that_a_reader_uses_by_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    before = code_digest(Replica)
    for name in ("readers.folder_dataset", "formats.pose_lists", "formats.calibration"):
        module = importlib.import_module(f"logvggt_jax.data.{name}")
        changed = tmp_path / f"{name}.py"
        changed.write_text(Path(module.__file__).read_text() + "# changed")
        with monkeypatch.context() as patch:
            patch.setattr(module, "__file__", str(changed))
            assert code_digest(Replica) != before
    assert code_digest(Replica) == before
