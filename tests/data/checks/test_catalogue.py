"""The catalogue has every data set with all that a user needs to know before fetching it."""

import importlib
from dataclasses import asdict

from logvggt_jax.data import DATASETS
from logvggt_jax.data.checks.catalogue import catalogue
from logvggt_jax.data.registry import READERS


def test_every_data_set_says_what_it_is():
    for reader in READERS.values():
        for field, value in asdict(reader.about).items():
            assert value or field == "extra", (reader.name, field)


def test_roles_are_the_papers():
    roles = {
        # What comes after the paper's own sets and the rooms, the paper does not use.
        role: {name for name in DATASETS[:18] if role in READERS[name].about.roles}
        for role in ("training", "evaluation")
    }
    assert roles["training"] == {*DATASETS[:11], "rooms"}
    assert roles["evaluation"] == {*DATASETS[11:17], "rooms", "scannet", "virtual_kitti", "co3dv2"}


def test_sets_whose_modules_read_hdf5_or_exr_files_name_the_extra():
    for reader in READERS.values():
        names = vars(importlib.import_module(reader.__module__))
        assert (reader.about.extra == "data") == bool({"read_hdf5", "read_exr"} & set(names)), reader.name


def test_text_keeps_to_the_width_and_loses_nothing():
    text = catalogue(80)
    assert all(len(line) <= 80 for line in text.splitlines())
    words = " ".join(text.split())
    for reader in READERS.values():
        about = reader.about
        for part in (reader.expects, about.source, about.licence, about.size, ", ".join(reader.splits)):
            assert " ".join(part.split()) in words
        assert f"\n{reader.name}: {reader.title}\n" in f"\n{text}"
