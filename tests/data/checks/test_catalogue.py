"""The catalogue has every data set with all that a user needs to know before fetching it."""

from __future__ import annotations

from dataclasses import fields

from logvggt_jax.data import DATASETS
from logvggt_jax.data.checks.catalogue import catalogue
from logvggt_jax.data.registry import READERS


def test_every_data_set_is_there_with_every_field():
    entries = catalogue()
    assert tuple(entry.name for entry in entries) == DATASETS
    for entry in entries:
        for field in fields(entry):
            if field.name not in ("metric", "extra"):
                assert getattr(entry, field.name), (entry.name, field.name)
        assert set(entry.roles) <= {"training", "evaluation"}


def test_roles_are_the_papers():
    training = {entry.name for entry in catalogue() if "training" in entry.roles}
    evaluation = {entry.name for entry in catalogue() if "evaluation" in entry.roles}
    assert training == {*DATASETS[:11], "rooms"}
    assert evaluation == {*DATASETS[11:], "scannet", "virtual_kitti", "co3dv2"}


def test_readers_and_catalogue_agree_on_the_extra():
    """Sets whose modules read HDF5 or EXR files say which extra they need."""
    for entry in catalogue():
        if entry.name != "rooms":
            names = vars(__import__(READERS[entry.name].__module__, fromlist=["_"]))
            assert (entry.extra == "data") == bool({"read_hdf5", "read_exr"} & set(names)), entry.name


def test_text_keeps_to_the_width_and_loses_nothing():
    for entry in catalogue():
        text = entry.text(80)
        assert all(len(line) <= 80 for line in text.splitlines())
        for part in (entry.title, entry.folder, entry.obtain, entry.licence, entry.size, ", ".join(entry.splits)):
            assert " ".join(part.split()) in " ".join(text.split())
