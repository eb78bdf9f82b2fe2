"""Models that ship: found by name, at 16 bits, with all of their provenance; and what a user can do wrong with them."""

import dataclasses
import json
import os
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rooms_teacher
import ship_model

from logvggt_jax.cli import main
from logvggt_jax.errors import InputError, MissingInput, OutputExists
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.parameters import unstack_layers
from logvggt_jax.training.config import TeacherConfig
from logvggt_jax.training.step.initialization import initial_parameters
from logvggt_jax.training.teaching.teacher import PlainVGGT
from logvggt_jax.weights import from_pretrained, load_model, read_provenance, resolve, save_model, shipped_models
from logvggt_jax.weights.half_precision import PARAMETERS_FILE, rounded
from logvggt_jax.weights.provenance import Provenance, TrainingRecord

CONFIGURATION = {"seed": 0, "data": {"cache_dir": "/tmp/rooms", "reverse": 0.5}}
RUN = TrainingRecord(configuration=CONFIGURATION, data="rooms (train)", steps=12, device="1 x cpu")
OF_A_RUN = Provenance("windows", 224, source="trained from random parameters in /tmp/run", training=RUN)
FACTS = {"command": "python train.py", "commit": "1a2b3c", "minutes": 8.0}


@pytest.fixture(scope="module")
def trained(tmp_path_factory, small_config, small_variables):
    """A model folder as training writes it, computing in bfloat16."""
    folder = tmp_path_factory.mktemp("run") / "model"
    save_model(folder, dataclasses.replace(small_config, dtype="bfloat16"), small_variables["params"], OF_A_RUN)
    return folder


@pytest.fixture(scope="module")
def shipped_once(tmp_path_factory, trained):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shipped_models, "ROOT", tmp_path_factory.mktemp("shipped"))
        return ship_model.ship(trained, "rooms", **FACTS)


@pytest.fixture
def shipped(shipped_once, tmp_path, monkeypatch):
    """The small model as the one that ships as `rooms`; a copy that a test may damage. No other file is here."""
    root = tmp_path / "package" / "shipped"
    shutil.copytree(shipped_once, root / "rooms")
    monkeypatch.setattr(shipped_models, "ROOT", root)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return root / "rooms"


def test_what_ships_becomes_a_teacher_without_its_windows(shipped, tmp_path):
    rooms_teacher.main([str(tmp_path / "teacher")])
    PlainVGGT(TeacherConfig(str(tmp_path / "teacher"), clip_length=24))
    with pytest.raises(InputError, match="trained for 'windows', a teacher is plain VGGT"):
        PlainVGGT(TeacherConfig("rooms", clip_length=24))
    with pytest.raises(SystemExit, match=r"^rooms_teacher.py: .*teacher"):
        rooms_teacher.main([str(tmp_path / "teacher")])


def test_the_shipped_model_is_the_trained_one_at_16_bits(shipped, small_config, small_variables):
    model, variables = load_model("rooms")
    assert model == LogVGGT(small_config), "computes in float32 wherever it is loaded"
    assert jax.tree.structure(variables) == jax.tree.structure(small_variables)
    for leaf, expected in zip(jax.tree.leaves(variables), jax.tree.leaves(small_variables), strict=True):
        assert isinstance(leaf, jax.Array) and leaf.dtype == jnp.float32 and leaf.shape == expected.shape
        np.testing.assert_allclose(leaf, expected, rtol=2**-11, atol=1e-7)
    assert sorted(file.name for file in shipped.iterdir()) == ["config.json", "params.safetensors"]
    assert (shipped / PARAMETERS_FILE).stat().st_size < 2.2 * sum(x.size for x in jax.tree.leaves(variables))


def test_its_name_stands_for_it_wherever_a_checkpoint_is_named(shipped, small_config, capsys):
    expected = jax.tree.leaves(load_model("rooms")[1])
    started = unstack_layers(initial_parameters(small_config, seed=3, weights="rooms"), small_config)
    for found in (from_pretrained("rooms")[1], {"params": started}):
        assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(found), expected, strict=True))
    assert resolve("rooms") == shipped
    assert main(["info", "rooms"]) == 0
    printed = capsys.readouterr().out
    for words in ("licence: Apache-2.0", "trained by: python train.py", "commit 1a2b3c", "steps: 12", "8 minutes"):
        assert words in printed


def test_it_says_all_that_is_known_of_its_training(shipped):
    provenance = read_provenance("rooms")
    configuration = {"seed": 0, "data": {"cache_dir": None, "reverse": 0.5}}
    assert provenance.training == dataclasses.replace(RUN, configuration=configuration, **FACTS)
    assert (provenance.trained_for, provenance.longer_edge, provenance.licence) == ("windows", 224, "Apache-2.0")
    assert "/tmp" not in (shipped / "config.json").read_text(), "no path of the machine that trained it"


def test_a_model_folder_here_comes_first_and_nothing_else_of_that_name_does(shipped, trained, small_variables):
    (Path("rooms") / "depth").mkdir(parents=True)
    assert resolve("rooms") == shipped, "a folder of data is no model"
    shutil.rmtree("rooms")
    shutil.copytree(trained, "rooms/model")
    assert resolve("rooms") == Path("rooms/model")
    _, variables = load_model("rooms")
    np.testing.assert_array_equal(
        variables["params"]["encoder"]["norm"]["scale"], small_variables["params"]["encoder"]["norm"]["scale"]
    )
    shutil.rmtree("rooms")
    for local in ("./rooms", Path("rooms")):
        with pytest.raises(MissingInput, match="rooms: no such file or folder"):
            resolve(local)


def test_another_name_gets_the_names_that_there_are(shipped):
    for load in (load_model, from_pretrained, read_provenance):
        with pytest.raises(MissingInput, match=r"kitchens.*: no such .*a model that ships with this package: rooms$"):
            load("kitchens")


def test_an_installation_without_the_model_says_so(shipped):
    shutil.rmtree(shipped)
    for load in (load_model, from_pretrained):
        with pytest.raises(MissingInput, match=r"^rooms: the model .* is not in this installation .*install"):
            load("rooms")


def test_weights_that_differ_from_their_digest_are_refused(shipped):
    file = shipped / PARAMETERS_FILE
    content = bytearray(file.read_bytes())
    content[-7] ^= 1
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"leaf \S+ differs from its digest .*install the package again") as caught:
        load_model("rooms")
    assert "\n" not in str(caught.value)
    file.write_bytes(content[:-7])
    with pytest.raises(InputError, match=r"params\.safetensors: not a readable safetensors file"):
        load_model("rooms")


@pytest.mark.parametrize("name", [PARAMETERS_FILE, "config.json"])
def test_a_pipe_in_place_of_a_file_is_not_waited_for(shipped, name):
    (shipped / name).unlink()
    os.mkfifo(shipped / name)
    with pytest.raises(InputError, match=f"{name}(: no such file| is no file but)"):
        load_model(shipped)


def test_a_pipe_among_the_parameters_is_not_waited_for(trained, tmp_path):
    folder = Path(shutil.copytree(trained, tmp_path / "model"))
    (folder / "params" / "_METADATA").unlink()
    os.mkfifo(folder / "params" / "_METADATA")
    with pytest.raises(InputError, match="_METADATA is neither a file nor a folder"):
        load_model(folder)


def test_a_description_that_was_changed_is_refused(shipped):
    file = shipped / "config.json"
    file.write_text(file.read_text().replace('"commit": "1a2b3c"', '"commit": "1a2b3d"'))
    with pytest.raises(InputError, match=r"config\.json: differs from its digest"):
        load_model("rooms")


def test_parameters_of_another_model_are_named(shipped):
    file = shipped / "config.json"
    description = json.loads(file.read_text())
    del description["digest"]
    description["config"]["depth_head"]["features"] = 16
    file.write_text(json.dumps(description))
    with pytest.raises(InputError, match=r"params\.safetensors: depth_head/\S+ has shape .* the configuration .* asks"):
        load_model("rooms")


@pytest.mark.parametrize(
    ("provenance", "missing"),
    [
        (Provenance("windows", 224), "configuration, data, steps, device"),
        (dataclasses.replace(OF_A_RUN, longer_edge=None), "longer_edge"),
        (dataclasses.replace(OF_A_RUN, training=dataclasses.replace(RUN, device=None)), "device"),
    ],
)
def test_a_model_of_unknown_origin_is_not_shipped(
    provenance, missing, tmp_path, monkeypatch, small_config, small_variables
):
    monkeypatch.setattr(shipped_models, "ROOT", tmp_path / "shipped")
    save_model(tmp_path / "model", small_config, small_variables["params"], provenance)
    with pytest.raises(InputError, match=f"does not say {missing};"):
        ship_model.ship(tmp_path / "model", "rooms", **FACTS)
    assert not (tmp_path / "shipped").exists()


def test_a_model_too_large_for_the_package_is_not_shipped(trained, shipped, monkeypatch):
    before = (shipped / "config.json").read_bytes()
    monkeypatch.setattr(ship_model, "MAX_BYTES", 100_000)
    with pytest.raises(InputError, match=r"takes [\d,]+ bytes at 16 bits, expected less than 100,000"):
        ship_model.ship(trained, "rooms", **FACTS)
    monkeypatch.undo()
    assert (shipped / "config.json").read_bytes() == before


def test_nothing_but_an_older_model_is_replaced(trained, shipped):
    ship_model.ship(trained, "rooms", **{**FACTS, "minutes": 9.0}, steps=1200)
    record = read_provenance("rooms").training
    assert (record.minutes, record.steps) == (9.0, 1200), "of all runs that led to it"
    shutil.rmtree(shipped)
    shipped.mkdir()
    (shipped / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputExists, match="not a model folder"):
        ship_model.ship(trained, "rooms", **FACTS)


def test_rounding_takes_the_type_that_changes_the_parameters_least():
    values = np.random.default_rng(0).standard_normal(1000).astype(np.float32)
    leaves, change = rounded({"a": {"b": values}})
    assert leaves["a/b"].dtype == np.float16
    assert change == pytest.approx(np.linalg.norm(leaves["a/b"] - values) / np.linalg.norm(values), rel=1e-3)
    leaves, change = rounded({"a": {"b": values * 1e6}})
    assert leaves["a/b"].dtype == "bfloat16" and change < 2**-8


def test_what_this_checkout_ships_is_sound_or_said_to_be_missing(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in shipped_models.SHIPPED:
        folder = shipped_models.ROOT / name
        if not folder.exists():
            with pytest.raises(MissingInput, match="not in this installation"):
                load_model(name)
            continue
        assert sum(file.stat().st_size for file in folder.iterdir()) < ship_model.MAX_BYTES
        provenance = read_provenance(name)
        assert provenance.licence == "Apache-2.0" and provenance.training is not None
        assert all(dataclasses.asdict(provenance.training).values()), "command, commit, configuration, data, …"
        model, variables = load_model(name)  # checks every digest
        edge = provenance.longer_edge // 2 // 14 * 14
        images = np.random.default_rng(0).integers(0, 256, (1, 3, edge, edge, 3), np.uint8)
        predictions = jax.jit(model.apply)(variables, images)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(predictions))
