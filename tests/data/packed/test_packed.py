"""A packed data set is the data set that was packed: its frames, its errors, its clips."""

import json
import pickle
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from layouts import blendedmvs, mvs_synth, seven_scenes

from logvggt_jax.cli import main
from logvggt_jax.data import open_dataset, training_batches
from logvggt_jax.data.checks.check import check_copy
from logvggt_jax.data.feeding.sampling import CovisibleDataset
from logvggt_jax.data.packed import pack as module
from logvggt_jax.data.packed.pack import pack
from logvggt_jax.errors import InputError, MissingPackage, OutputExists
from logvggt_jax.files import atomic_file

NAME = "seven_scenes"


def write_scenes(root: Path) -> Path:
    """Three sequences of a scene, one frame of which is damaged."""
    for number in (1, 2, 3):
        seven_scenes.LAYOUT.write(root / str(number), seven_scenes.LAYOUT.views)
        (original,) = (root / str(number)).glob("*/seq-*")
        target = root / "scene" / f"seq-{number:02d}"
        target.parent.mkdir(exist_ok=True)
        original.rename(target)
        (root / str(number) / original.parent.name).rmdir()
        (root / str(number)).rmdir()
    damaged = next((root / "scene" / "seq-02").glob("frame-000002.color.*"))
    damaged.write_bytes(damaged.read_bytes()[:100])
    return root


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scenes(tmp_path_factory.mktemp("scenes"))


@pytest.fixture(scope="module")
def packed(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("packed") / "here"
    report = pack(NAME, scenes, output, frames_per_shard=8)
    assert report.written == 2 and report.kept == 0 and report.sequences == 3
    assert len(report.broken) == 1 and "frame-000002" in report.broken[0] and "seq-02" in report.text()
    return output


def damaged_copy(packed: Path, target: Path) -> Path:
    target.mkdir()
    for path in packed.iterdir():
        if path.is_file():
            (target / path.name).write_bytes(path.read_bytes())
    return target


def same(found: Any, expected: Any) -> None:
    for a, b in zip(found[:4], expected[:4], strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype


def test_frames_names_sizes_and_errors_are_the_readers(scenes: Path, packed: Path) -> None:
    original, found = open_dataset(NAME, scenes), pickle.loads(pickle.dumps(open_dataset(NAME, packed)))
    assert found.sequences == original.sequences and found.identity == original.identity
    for name in original.sequences:
        assert found.num_frames(name) == original.num_frames(name)
        assert found.frame_names(name) == original.frame_names(name)
        assert found.image_size(name) == original.image_size(name)
        assert found.sfm_extrinsics(name, [0]) is None
    same(found.read(original.sequences[2], [3, 0]), original.read(original.sequences[2], [3, 0]))
    with pytest.raises(InputError) as expected:
        original.read(original.sequences[1], [2])
    with pytest.raises(InputError) as error:
        found.read(original.sequences[1], [2])
    assert str(error.value) == str(expected.value)


@pytest.mark.parametrize("max_broken", [0.0, 0.5])
def test_clips_are_those_of_the_originals_bit_for_bit(scenes: Path, packed: Path, max_broken: float) -> None:
    def batches(root: Path) -> list[Any]:
        dataset = open_dataset(NAME, root)
        settings = {"clip_length": 2, "batch_size": 2, "sizes": [(28, 42), (42, 28)], "seed": 3, "stride": (1, 2)}
        with training_batches({NAME: dataset}, max_broken=max_broken, num_threads=0, **settings) as source:
            found = []
            try:
                for _ in range(4):
                    found.append((next(source), source.names, source.get_state()))
            except InputError as error:
                found.append(str(error))
            return found

    original, found = batches(scenes), batches(packed)
    assert len(original) == len(found) and (max_broken == 0 or len(found) == 4)
    for a, b in zip(original, found, strict=True):
        if isinstance(a, str):
            assert a == b
            continue
        assert a[1:] == b[1:] and a[0].keys() == b[0].keys()
        for field in a[0]:
            np.testing.assert_array_equal(a[0][field], b[0][field])


def test_a_walk_over_photographs_is_the_same_walk(tmp_path: Path) -> None:
    layout = blendedmvs.LAYOUT
    layout.write(tmp_path / "set", layout.views)
    pack("blendedmvs", tmp_path / "set", tmp_path / "packed")
    original, found = (open_dataset("blendedmvs", tmp_path / each) for each in ("set", "packed"))
    assert isinstance(original, CovisibleDataset) and isinstance(found, CovisibleDataset)
    assert found.covisibility(layout.sequence) == original.covisibility(layout.sequence)
    assert not isinstance(found, type(original)) and found.title == original.title


def test_an_interrupted_run_goes_on_and_ends_as_one_left_alone(
    scenes: Path, packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, whole = tmp_path / "here", module._write
    left: list[Path] = []

    def killed(reader: Any, folder: Path, number: int, *others: Any) -> Any:
        if number == 1:
            with atomic_file(folder / "shard-00001.array_record") as temporary:
                temporary.write_bytes(b"half")
                left.append(temporary)
            (folder / "shard-00001.array_record").rename(left[0])
            raise KeyboardInterrupt
        return whole(reader, folder, number, *others)

    monkeypatch.setattr(module, "_write", killed)
    with pytest.raises(KeyboardInterrupt):
        pack(NAME, scenes, output, frames_per_shard=8)
    assert not (output / "packed.json").exists()
    monkeypatch.setattr(module, "_write", whole)
    report = pack(NAME, scenes, output, frames_per_shard=8)
    assert (report.written, report.kept) == (1, 1) and len(report.broken) == 1
    assert (output / "packed.json").read_bytes() == (packed / "packed.json").read_bytes()
    assert left and not left[0].exists()


def test_a_damaged_shard_is_named_and_written_anew(scenes: Path, packed: Path, tmp_path: Path) -> None:
    output = damaged_copy(packed, tmp_path / "here")
    shard = output / "shard-00001.array_record"
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 255
    shard.write_bytes(content)
    dataset = open_dataset(NAME, output)
    with pytest.raises(InputError, match=r"shard-00001\.array_record: cannot be read .*pack the data set again"):
        dataset.read(dataset.sequences[2], range(4))
    shard.write_bytes(content[:-10])
    with pytest.raises(InputError, match=r"shard-00001\.array_record: \d+ bytes, expected \d+"):
        open_dataset(NAME, output)
    report = pack(NAME, scenes, output, frames_per_shard=8)
    assert (report.written, report.kept) == (1, 1)
    assert shard.read_bytes() == (packed / shard.name).read_bytes()


def test_a_run_that_ended_while_it_listed_goes_on(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: Any) -> Any:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(module, "_placed", stopped)
        pack(NAME, scenes, tmp_path / "here")
    assert pack(NAME, scenes, tmp_path / "here").written == 1


def test_what_was_corrected_since_is_written_anew_and_nothing_else(tmp_path: Path) -> None:
    scenes = write_scenes(tmp_path / "scenes")
    output = tmp_path / "packed"
    pack(NAME, scenes, output, frames_per_shard=4)
    pose = next((scenes / "scene/seq-03").glob("frame-000001.pose.txt"))
    np.savetxt(pose, np.eye(4))
    damaged = next((scenes / "scene/seq-02").glob("frame-000002.color.*"))
    damaged.write_bytes(damaged.with_name(damaged.name.replace("000002", "000001")).read_bytes())
    report = pack(NAME, scenes, output, frames_per_shard=4)
    assert (report.written, report.kept, report.broken) == (2, 1, ())
    original, found = open_dataset(NAME, scenes), open_dataset(NAME, output)
    for name in original.sequences:
        same(found.read(name, range(4)), original.read(name, range(4)))
        assert found.content_digest(name) == original.content_digest(name)


def test_a_file_that_was_mended_without_a_byte_more_or_less_is_written_anew(tmp_path: Path) -> None:
    layout = blendedmvs.LAYOUT
    layout.write(tmp_path / "set", layout.views)
    depth = tmp_path / "set" / layout.depth
    whole = depth.read_bytes()
    depth.write_bytes(b"??" + whole[2:])
    assert len(pack("blendedmvs", tmp_path / "set", tmp_path / "packed").broken) == 1
    report = pack("blendedmvs", tmp_path / "set", tmp_path / "packed")
    assert (report.written, report.kept, len(report.broken)) == (0, 1, 1)
    depth.write_bytes(whole)
    report = pack("blendedmvs", tmp_path / "set", tmp_path / "packed")
    assert (report.written, report.kept, report.broken) == (1, 0, ())
    original, found = (open_dataset("blendedmvs", tmp_path / each) for each in ("set", "packed"))
    same(found.read(layout.sequence, range(4)), original.read(layout.sequence, range(4)))


def test_a_missing_package_or_too_little_memory_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mvs_synth.LAYOUT.write(tmp_path / "set", mvs_synth.LAYOUT.views)
    with monkeypatch.context() as patch, pytest.raises(MissingPackage, match="OpenEXR"):
        patch.setitem(sys.modules, "OpenEXR", None)
        pack("mvs_synth", tmp_path / "set", tmp_path / "packed")
    assert not (tmp_path / "packed/packed.json").exists()

    def full(*_: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(module, "frame_record", full)
        pack("mvs_synth", tmp_path / "set", tmp_path / "packed")
    assert not (tmp_path / "packed/packed.json").exists()
    assert pack("mvs_synth", tmp_path / "set", tmp_path / "packed").broken == ()


def test_damage_beside_the_frames_of_one_scene_keeps_no_other_from_being_packed(tmp_path: Path) -> None:
    layout = blendedmvs.LAYOUT
    layout.write(tmp_path / "set", layout.views)
    whole = "f" * 24
    shutil.copytree(tmp_path / "set" / layout.sequence, tmp_path / "set" / whole)
    (tmp_path / "set" / layout.sequence / "cams/pair.txt").unlink()
    report = pack("blendedmvs", tmp_path / "set", tmp_path / "packed")
    assert len(report.broken) == 1 and "pair.txt: no such file" in report.broken[0]
    found = open_dataset("blendedmvs", tmp_path / "packed")
    assert found.num_frames(whole) == len(layout.views)
    with pytest.raises(InputError, match=r"pair\.txt: no such file"):
        found.num_frames(layout.sequence)


def test_a_sequence_that_is_mended_is_packed_and_the_others_keep_their_shards(tmp_path: Path) -> None:
    layout = blendedmvs.LAYOUT
    layout.write(tmp_path / "set", layout.views)
    others = ["e" * 24, "f" * 24]
    for name in others:
        shutil.copytree(tmp_path / "set" / layout.sequence, tmp_path / "set" / name)
    pairs = tmp_path / "set" / layout.sequence / "cams/pair.txt"
    content = pairs.read_bytes()
    pairs.unlink()
    arguments = "blendedmvs", tmp_path / "set", tmp_path / "packed"
    assert sorted(open_dataset("blendedmvs", tmp_path / "set").sequences)[0] == layout.sequence
    report = pack(*arguments, frames_per_shard=4)
    assert (report.written, report.kept, len(report.broken)) == (2, 0, 1)
    pairs.write_bytes(content)
    report = pack(*arguments, frames_per_shard=4)
    assert (report.written, report.kept, report.broken) == (1, 2, ())
    assert pack(*arguments, frames_per_shard=4).kept == 3
    original, found = (open_dataset("blendedmvs", tmp_path / each) for each in ("set", "packed"))
    assert found.sequences == original.sequences
    for name in original.sequences:
        same(found.read(name, range(4)), original.read(name, range(4)))
        assert found.content_digest(name) == original.content_digest(name)
    # It is lost again: what else there is stays.
    pairs.unlink()
    report = pack(*arguments, frames_per_shard=4)
    assert (report.written, report.kept, len(report.broken)) == (0, 2, 1)
    assert len(list((tmp_path / "packed").glob("*.array_record"))) == 2


def test_an_index_that_was_changed_is_refused(packed: Path, tmp_path: Path) -> None:
    output = damaged_copy(packed, tmp_path / "here")
    path = output / "packed.json"
    path.write_text(path.read_text().replace('"frames": 4', '"frames": 5', 1))
    with pytest.raises(InputError, match=r"packed\.json: differs from its digest"):
        open_dataset(NAME, output)
    for text in ("{", "[" * 100_000):
        path.write_text(text)
        with pytest.raises(InputError, match=r"packed\.json: not valid JSON"):
            open_dataset(NAME, output)


def test_another_set_split_option_or_plan_is_refused(scenes: Path, packed: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds seven_scenes, packed, and not replica"):
        open_dataset("replica", packed)
    with pytest.raises(InputError, match="no lists for the split 'test', only all"):
        open_dataset(NAME, packed, "test")
    with pytest.raises(InputError, match="begun with other data or settings"):
        pack(NAME, scenes, packed, frames_per_shard=4)
    older = damaged_copy(packed, tmp_path / "older")
    plan = json.loads((older / "plan.json").read_text())
    del plan["last"]
    (older / "plan.json").write_text(json.dumps(plan))
    with pytest.raises(
        InputError, match=r"older was packed in an older format, .* choose another output, or delete it"
    ):
        pack(NAME, scenes, older, frames_per_shard=8)
    (tmp_path / "mine.txt").touch()
    with pytest.raises(OutputExists, match="is not empty"):
        pack(NAME, scenes, tmp_path)
    with pytest.raises(InputError, match=r"is a packed data set: check the copy that was packed"):
        check_copy(NAME, packed)
    with pytest.raises(InputError, match="is packed already"):
        pack(NAME, packed, tmp_path / "twice")
    with pytest.raises(InputError, match="rooms are made when they are read: there is no copy to pack"):
        pack("rooms", tmp_path, tmp_path / "rooms")


def test_sequences_of_another_split_are_known_by_name_alone(scenes: Path, tmp_path: Path) -> None:
    lists = {"TrainSplit.txt": "sequence1\nsequence3\n", "TestSplit.txt": "sequence2\n"}
    for name, text in lists.items():
        (scenes / "scene" / name).write_text(text)
    try:
        pack(NAME, scenes, tmp_path / "here", split="train")
    finally:
        for name in lists:
            (scenes / "scene" / name).unlink()
    held_out = open_dataset(NAME, tmp_path / "here", "test")
    assert held_out.sequences == ("scene/seq-02",)
    with pytest.raises(InputError, match="the split 'train' was packed"):
        held_out.num_frames("scene/seq-02")
    assert open_dataset(NAME, tmp_path / "here", "train").num_frames("scene/seq-03") == 4


def test_the_command_packs_with_several_processes(
    scenes: Path, packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["data", "pack", NAME, str(scenes), "--output", str(tmp_path / "here"), "--frames-per-shard", "8"]
    assert main([*command, "--workers", "2"]) == 0
    assert "3 sequences, 12 frames" in capsys.readouterr().out
    for path in packed.glob("*.*"):
        assert (tmp_path / "here" / path.name).read_bytes() == path.read_bytes()
