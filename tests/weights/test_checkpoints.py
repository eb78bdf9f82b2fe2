"""Model folders: what is saved comes back, and what is damaged is named."""

import dataclasses
import hashlib
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest
from safetensors.numpy import save_file

from logvggt_jax.cli import main
from logvggt_jax.errors import DiskError, InputError, OutputExists
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.weights import checkpoints
from logvggt_jax.weights.checkpoints import (
    convert,
    from_pretrained,
    load_model,
    read_config,
    read_provenance,
    save_model,
)
from logvggt_jax.weights.digests import digests, verify_digests
from logvggt_jax.weights.folder import read_description, write_description
from logvggt_jax.weights.lazy import LazyTensors
from logvggt_jax.weights.provenance import Provenance
from logvggt_jax.weights.vggt import params_from_vggt


@pytest.fixture(scope="module")
def saved(tmp_path_factory, small_config, small_variables):
    path = tmp_path_factory.mktemp("saved") / "model"
    save_model(path, small_config, small_variables["params"])
    return path


@pytest.fixture
def folder(saved, tmp_path):
    """A copy of the saved model that a test may damage."""
    return shutil.copytree(saved, tmp_path / "model")


@pytest.fixture(scope="module")
def vggt_file(tmp_path_factory, vggt_state_dict):
    path = tmp_path_factory.mktemp("vggt") / "model.safetensors"
    save_file(vggt_state_dict, path)
    return path


def _edit(folder, change):
    file = folder / "config.json"
    description = json.loads(file.read_text())
    description.pop("digest", None)  # as in folders written before it was there, and as after an edit on purpose
    change(description)
    file.write_text(json.dumps(description))


def _assert_same(tree, other):
    assert jax.tree.structure(tree) == jax.tree.structure(other)
    for leaf, expected in zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True):
        assert leaf.dtype == expected.dtype
        np.testing.assert_array_equal(leaf, expected)


def _hidden(path):
    return [entry.name for entry in path.iterdir() if entry.name.startswith(".")]


def test_a_model_comes_back_bit_for_bit(saved, small_config, small_variables):
    model, variables = load_model(saved)
    assert model == LogVGGT(small_config)
    _assert_same(variables, small_variables)
    device = jnp.zeros(()).devices()
    assert all(isinstance(leaf, jax.Array) and leaf.devices() == device for leaf in jax.tree.leaves(variables))


def test_parameters_saved_on_several_devices_load_on_one(tmp_path, small_config, small_variables):
    devices = jax.devices()[:2]
    mesh = jax.make_mesh((2,), ("data",), axis_types=(jax.sharding.AxisType.Auto,), devices=devices)
    everywhere = jax.device_put(small_variables["params"], jax.NamedSharding(mesh, jax.P()))
    everywhere["encoder"]["norm"]["scale"] = jax.device_put(
        small_variables["params"]["encoder"]["norm"]["scale"], jax.NamedSharding(mesh, jax.P("data"))
    )
    save_model(tmp_path / "model", small_config, everywhere)
    _, variables = load_model(tmp_path / "model")
    _assert_same(variables["params"], small_variables["params"])


def test_a_folder_says_what_its_weights_were_trained_for(tmp_path, folder, vggt_file, small_config, small_variables):
    provenance = Provenance("windows", 224, "CC-BY-4.0", "rooms")
    save_model(tmp_path / "new", small_config, small_variables["params"], provenance)
    assert read_provenance(tmp_path / "new") == provenance
    assert read_provenance(vggt_file).trained_for == "vggt"
    # Folders of before the record load, and say that they do not know.
    _edit(folder, lambda description: description.pop("provenance"))
    assert read_provenance(folder) == Provenance()
    _assert_same(load_model(folder)[1], small_variables)
    for wrong in ({"trained_for": "chess"}, {"longer_edge": 500}, {"author": "me"}, ["windows"]):
        _edit(folder, lambda description, wrong=wrong: description.update(provenance=wrong))
        with pytest.raises(InputError, match=r"config\.json: .*provenance"):
            read_provenance(folder)


def test_a_relative_path_works(tmp_path, monkeypatch, saved, small_config, small_variables):
    monkeypatch.chdir(tmp_path)
    save_model("runs/model", small_config, small_variables["params"])
    model, _ = load_model("runs/model")
    assert model.config == small_config


def test_saving_again_replaces_the_older_model(folder, small_config, small_variables):
    params = jax.tree.map(lambda leaf: leaf + 1, small_variables["params"])
    save_model(folder, small_config, params)
    _assert_same(load_model(folder)[1]["params"], params)
    assert _hidden(folder.parent) == []


def test_a_failed_save_leaves_the_older_model_and_nothing_else(folder, small_config, small_variables, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError("no space left on device")

    monkeypatch.setattr(ocp.AsyncCheckpointer, "save", fail)
    for path in (folder, folder.parent / "fresh"):
        with pytest.raises(OSError, match="no space left"):
            save_model(path, small_config, small_variables["params"])
    monkeypatch.undo()
    assert [entry.name for entry in folder.parent.iterdir()] == ["model"]
    _assert_same(load_model(folder)[1], small_variables)


def test_a_full_disk_is_one_line_with_the_path(tmp_path, small_config, small_variables, monkeypatch):
    def fail(*args, **kwargs):  # as Orbax does it
        raise ValueError("RESOURCE_EXHAUSTED: Error writing: No space left on device [os_error_code='28']")

    monkeypatch.setattr(ocp.AsyncCheckpointer, "save", fail)
    with pytest.raises(DiskError, match=r"/model: No space left on device$"):
        save_model(tmp_path / "model", small_config, small_variables["params"])
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_no_model_is_never_overwritten(tmp_path, small_config, small_variables):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(FileExistsError, match="not a model folder"):
        save_model(tmp_path, small_config, small_variables["params"])
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_changed_leaf_is_named(folder, small_variables):
    params = jax.tree.map(np.array, small_variables["params"])
    params["gccr"]["key"]["kernel"].view(np.uint8)[3, 5] ^= 1
    shutil.rmtree(folder / "params")
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(folder / "params", params)
    with pytest.raises(ValueError, match=r"model: leaf gccr/key/kernel differs from its digest.*copy or convert"):
        load_model(folder)


@pytest.mark.usefixtures("abandoned_reads")
def test_flipped_bytes_of_a_stored_array_are_noticed(folder):
    data = max((file for file in folder.rglob("*") if file.parent.name == "d"), key=lambda file: file.stat().st_size)
    flipped = bytearray(data.read_bytes())
    middle = len(flipped) // 2
    flipped[middle : middle + 64] = bytes(255 - byte for byte in flipped[middle : middle + 64])
    data.write_bytes(flipped)
    with pytest.raises(ValueError, match="damaged") as caught:
        load_model(folder)
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.usefixtures("abandoned_reads")
def test_a_truncated_or_missing_file_is_an_error(folder):
    data = max((file for file in folder.rglob("*") if file.parent.name == "d"), key=lambda file: file.stat().st_size)
    data.write_bytes(data.read_bytes()[: data.stat().st_size // 2])
    with pytest.raises(ValueError, match=r"params: cannot be read .*damaged"):
        load_model(folder)
    shutil.rmtree(folder / "params")
    with pytest.raises(FileNotFoundError, match=r"params: the parameters are missing"):
        load_model(folder)


def test_a_configuration_of_another_model_names_the_parameter(folder):
    _edit(folder, lambda description: description["config"]["depth_head"].update(features=16))
    with pytest.raises(
        ValueError, match=r"params: depth_head/\S+ has shape .* the configuration .* asks for"
    ) as caught:
        load_model(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d["config"]["encoder"].update(widht=3), r"unknown field model\.encoder\.widht"),
        (lambda d: d["config"]["windows"].update(stride=4), r"model\.windows\.stride=4"),
        (lambda d: d.update(version=99), r"format version 99"),
        (lambda d: d.update(format="other"), r"not the description of a model of this package.*logvggt convert"),
        (lambda d: d.pop("digests"), r"config or digests are missing"),
        (lambda d: d["digests"].pop("encoder/cls_token"), r"leaf encoder/cls_token has no digest"),
    ],
)
def test_a_wrong_description_is_named(folder, change, words):
    _edit(folder, change)
    with pytest.raises(ValueError, match=words) as caught:
        load_model(folder)
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


def test_a_description_that_is_missing_or_cut_is_named(folder):
    file = folder / "config.json"
    file.write_text(file.read_text()[:100])
    with pytest.raises(ValueError, match=r"config\.json: not valid JSON"):
        load_model(folder)
    file.unlink()
    for load in (load_model, from_pretrained):
        with pytest.raises(FileNotFoundError, match=r"config\.json: no such file"):
            load(folder)


def test_digests_tell_value_shape_and_type_apart():
    tree = {"a": np.zeros((2, 3), np.float32), "key": jax.random.key(1), "step": np.int32(4)}
    same = digests(tree)
    verify_digests(tree, same, "somewhere")
    others = [
        {"a": np.zeros((3, 2), np.float32)},
        {"a": np.zeros((2, 3), np.int32)},
        {"a": -np.zeros((2, 3), np.float32)},
        {"key": jax.random.key(2)},
        {"step": np.int32(5)},
    ]
    for other in others:
        (name,) = other
        with pytest.raises(ValueError, match=f"somewhere: leaf {name} differs"):
            verify_digests({**tree, **other}, same, "somewhere")
    with pytest.raises(ValueError, match="leaf a is not in the checkpoint"):
        verify_digests({"key": tree["key"], "step": tree["step"]}, same, "somewhere")


def test_digests_of_earlier_versions_are_compared_as_they_were_made():
    tree = {"a": np.zeros((2, 3), np.float32), "b": np.ones(4, np.int32)}
    earlier = hashlib.blake2b(b"float32(2, 3)" + tree["a"].tobytes(), digest_size=16).hexdigest()
    mixed = {**digests(tree), "a": earlier}
    verify_digests(tree, mixed, "somewhere")
    with pytest.raises(ValueError, match="somewhere: leaf a differs"):
        verify_digests({**tree, "a": tree["a"] + 1}, mixed, "somewhere")


def test_a_converted_vggt_equals_the_one_converted_in_memory(tmp_path, vggt_file, vggt_config, vggt_state_dict, capsys):
    report = convert(vggt_file, tmp_path / "model", point_head=True)
    assert len(report.used) == len(vggt_state_dict) - 2
    said = capsys.readouterr()
    assert f"{len(report.used)} tensors used, 2 skipped, 12 parameters initialised" in said.out
    assert "the folder takes about" in said.err and "encoder of 1 blocks and width 16" in said.err
    assert [entry.name for entry in tmp_path.iterdir()] == ["model"]
    model, variables = load_model(tmp_path / "model")
    assert read_provenance(tmp_path / "model") == Provenance("vggt", 518, None, f"VGGT checkpoint {vggt_file}")
    direct, direct_variables = from_pretrained(vggt_file, point_head=True)
    assert model == direct == LogVGGT(vggt_config)
    _assert_same(variables, direct_variables)


def test_a_refused_conversion_leaves_nothing(tmp_path, vggt_state_dict):
    bad = dict(vggt_state_dict)
    bad["camera_head.embed_pose.weight"] = np.zeros((32, 8), np.float32)
    save_file(bad, tmp_path / "model.safetensors")
    with pytest.raises(
        ValueError, match=r"^\S+model\.safetensors: camera_head\.embed_pose\.weight has shape \(32, 8\)"
    ):
        convert(tmp_path / "model.safetensors", tmp_path / "model")
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.safetensors"]


def _without(tensors, name):
    return {other: tensor for other, tensor in tensors.items() if other != name}


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: _without(t, "camera_head.token_norm.bias"), r"1 of \d+ keys are missing.*token_norm\.bias"),
        (lambda t: {**t, "aggregator.gate": np.zeros(3, np.float32)}, "unknown key 'aggregator.gate'"),
        (lambda t: {**t, "camera_head.embed_pose.weight": np.zeros((32, 8), np.float32)}, r"has shape \(32, 8\), exp"),
        (lambda t: {**t, "camera_head.embed_pose.bias": np.zeros(32, np.int64)}, "embed_pose.bias is int64, expected"),
    ],
)
def test_names_shapes_and_types_are_checked_before_a_tensor_is_read(
    tmp_path, vggt_state_dict, write_torch_file, monkeypatch, suffix, change, words
):
    file, tensors = tmp_path / f"model{suffix}", change(vggt_state_dict)
    save_file(tensors, file) if suffix == ".safetensors" else write_torch_file(file, tensors)
    monkeypatch.setattr(LazyTensors, "__getitem__", lambda _, name: pytest.fail(f"reads {name}"))
    for check in (read_config, from_pretrained, lambda path: convert(path, tmp_path / "model")):
        with pytest.raises(InputError, match=rf"^\S+model{suffix}: .*{words}"):
            check(file)


def test_a_sound_checkpoint_tells_its_sizes_without_a_tensor_read(vggt_file, vggt_config, monkeypatch):
    monkeypatch.setattr(LazyTensors, "__getitem__", lambda _, name: pytest.fail(f"reads {name}"))
    assert read_config(vggt_file, point_head=True) == vggt_config


def test_conversion_checks_the_destination_before_it_reads(tmp_path, vggt_file, saved, monkeypatch):
    monkeypatch.setattr(checkpoints, "open_state_dict", lambda path: pytest.fail("read before the check"))
    monkeypatch.setattr(checkpoints, "resolve", lambda path: pytest.fail("looked for before the check"))
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputExists, match="--overwrite"):
        convert(vggt_file, tmp_path)
    with pytest.raises(OutputExists, match="is no earlier result"):
        convert(vggt_file, tmp_path, overwrite=True)
    with pytest.raises(DiskError, match=r"notes\.txt is no folder"):
        convert(vggt_file, tmp_path / "notes.txt" / "model")
    with pytest.raises(OutputExists, match="--overwrite"):
        convert(vggt_file, saved)
    # A hub repository has a description of the same name.
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(OutputExists, match=r"notes\.txt in it is not of an earlier result"):
        convert(vggt_file, tmp_path, overwrite=True)
    (tmp_path / "notes.txt").unlink()
    with pytest.raises(OutputExists, match="not a model folder"):
        convert(vggt_file, tmp_path, overwrite=True)


def test_conversion_replaces_a_model_folder_only_when_asked(folder, vggt_file, vggt_config, small_variables):
    with pytest.raises(OutputExists, match="--overwrite"):
        convert(vggt_file, folder)
    _assert_same(load_model(folder)[1], small_variables)
    with pytest.raises(InputError, match="no such file"):
        convert(folder.parent / "absent.pt", folder, overwrite=True)
    _assert_same(load_model(folder)[1], small_variables)
    within = shutil.copy(vggt_file, folder / "params")
    with pytest.raises(InputError, match=rf"output {folder} contains {within}, which is read: choose another output"):
        convert(within, folder, overwrite=True)
    convert(vggt_file, folder, overwrite=True)
    assert load_model(folder)[0].config == dataclasses.replace(vggt_config, point_head=None)
    assert [entry.name for entry in folder.parent.iterdir()] == ["model"]


def test_conversion_says_the_space_it_needs_and_stops_without(tmp_path, vggt_file, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10**9, 10**9, 1000))
    with pytest.raises(DiskError, match=r"needs about [\d.]+ MB, 0\.0 MB are free"):
        convert(vggt_file, tmp_path / "model")
    assert list(tmp_path.iterdir()) == []


def test_a_model_folder_is_not_converted_again(saved, tmp_path):
    with pytest.raises(InputError, match="is a model folder already"):
        convert(saved, tmp_path / "model")


def test_the_compute_type_can_be_chosen(saved, small_config, small_variables):
    model, variables = from_pretrained(saved, dtype="bfloat16")
    assert model.config == dataclasses.replace(small_config, dtype="bfloat16")
    _assert_same(variables, small_variables)
    with pytest.raises(ValueError, match="no point head"):
        from_pretrained(saved, point_head=True)


def test_a_path_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing/here/at/all: no such file or folder"):
        from_pretrained(tmp_path / "nothing" / "here" / "at" / "all")
    with pytest.raises(FileNotFoundError, match=r"nothing/config\.json"):
        load_model(tmp_path / "nothing")


def test_every_flipped_bit_of_a_description_is_noticed(tmp_path, small_config):
    provenance = dataclasses.asdict(Provenance("windows", 224, "CC-BY-4.0", "rooms, Bärenweg"))
    write_description(
        tmp_path,
        {
            "config": {part: small_config.to_dict()[part] for part in ("aggregator", "windows", "dtype")},
            "provenance": provenance,
            "digests": {"encoder/norm/scale": "0f" * 16},
            "libraries": {"jax": "0.10.2"},
        },
    )
    file = tmp_path / "config.json"
    good, content = file.read_bytes(), read_description(tmp_path)
    for bit in range(8 * len(good)):
        flipped = bytearray(good)
        flipped[bit // 8] ^= 1 << bit % 8
        file.write_bytes(flipped)
        try:
            found = read_description(tmp_path)
        except InputError as error:
            assert str(file) in str(error) and "\n" not in str(error)
        else:
            assert found == content, f"bit {bit} changes the model without a word: {bytes(flipped)!r}"


def test_a_folder_from_before_the_description_had_a_digest_loads(folder, small_variables):
    _edit(folder, lambda description: None)
    _assert_same(load_model(folder)[1], small_variables)


def test_an_edit_by_hand_is_told_from_damage(folder):
    file = folder / "config.json"
    file.write_text(file.read_text().replace('"rope_base": 100.0', '"rope_base": 101.0'))
    with pytest.raises(InputError, match=r"config\.json: differs from its digest.*edited on purpose, remove its entry"):
        load_model(folder)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_stored_model_with_values_that_are_not_finite_is_refused(tmp_path, small_config, small_variables, value):
    params = jax.tree.map(np.array, small_variables["params"])
    params["gccr"]["key"]["kernel"][3, 5] = value
    save_model(tmp_path / "model", small_config, params)
    with pytest.raises(InputError, match=rf"gccr/key/kernel has 1 of \d+ values .*first at \(3, 5\): {value}"):
        load_model(tmp_path / "model")


def test_a_training_runs_folder_means_its_model(folder, small_variables):
    run = folder.parent
    (run / "checkpoints" / "6").mkdir(parents=True)
    for load in (load_model, from_pretrained):
        _assert_same(load(run)[1], small_variables)
    assert read_provenance(run) == Provenance()
    with pytest.raises(InputError, match=r"the model of this training run is \S+/model$"):
        load_model(run / "checkpoints" / "6")


def test_a_missing_parameters_folder_is_said_rather_than_taken_for_vggts(folder):
    shutil.rmtree(folder / "params")
    with pytest.raises(FileNotFoundError, match=r"params: the parameters are missing"):
        from_pretrained(folder)


def test_a_misspelt_folder_is_answered_with_the_right_one(saved):
    for load in (load_model, from_pretrained):
        with pytest.raises(FileNotFoundError, match=rf"did you mean {saved}\?"):
            load(saved.with_name("modle"))


def test_weights_by_any_name_are_vggts(tmp_path, write_torch_file, vggt_state_dict, vggt_config):
    content = {"epoch": 3, "state_dict": {f"module.{name}": tensor for name, tensor in vggt_state_dict.items()}}
    write_torch_file(tmp_path / "checkpoint-best.pth", content)
    model, variables = from_pretrained(tmp_path, point_head=True)
    assert model.config == vggt_config
    expected = vggt_state_dict["aggregator.patch_embed.norm.weight"]
    np.testing.assert_array_equal(variables["params"]["encoder"]["norm"]["scale"], expected)
    assert read_provenance(tmp_path) == Provenance("vggt", 518, None, f"VGGT checkpoint {tmp_path}")


def test_a_streamvggt_checkpoint_is_converted_key_by_key(
    tmp_path, write_torch_file, vggt_state_dict, vggt_config, capsys
):
    """As its training writes it: under `model`, behind the prefix of a wrapper, with the optimiser beside it."""
    wrapped = {f"module.{name}": tensor for name, tensor in vggt_state_dict.items()}
    moments = {"state": {0: {"exp_avg": vggt_state_dict["aggregator.camera_token"]}}}
    content = {"args": {"lr": 1e-5}, "model": wrapped, "optimizer": moments, "epoch": 3}
    write_torch_file(tmp_path / "checkpoint.pth", content)
    command = ["convert", str(tmp_path / "checkpoint.pth"), "--output", str(tmp_path / "model")]
    assert main([*command, "--point-head", "--trained-for", "causal", "--keys"]) == 0

    model, variables = load_model(tmp_path / "model")
    assert model.config == vggt_config
    expected, _ = params_from_vggt(vggt_state_dict, vggt_config)
    _assert_same(variables, {"params": expected})
    assert read_provenance(tmp_path / "model").trained_for == "causal"
    lines = capsys.readouterr().out.splitlines()
    reported = [line.split()[1] for line in lines if line.startswith(("  used: ", "  skipped: "))]
    assert sorted(reported) == sorted(vggt_state_dict)
    assert "  used: aggregator.camera_token -> aggregator/camera_token" in lines
    fused = "aggregator/frame_block_0/attention/"
    assert f"  used: aggregator.frame_blocks.0.attn.qkv.weight -> {fused}query/kernel, {fused}key_value/kernel" in lines


def test_a_checkpoint_of_another_layout_is_one_line(tmp_path, vggt_state_dict):
    other = {name.replace("aggregator.", "decoder."): tensor for name, tensor in vggt_state_dict.items()}
    save_file(other, tmp_path / "model.safetensors")
    with pytest.raises(
        InputError, match=r"^\S+model\.safetensors: the state dict lacks aggregator\.\S+, which VGGT has"
    ):
        convert(tmp_path / "model.safetensors", tmp_path / "model", trained_for="causal")
