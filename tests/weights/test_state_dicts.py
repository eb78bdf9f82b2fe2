"""Prefixes of names, and the model among the entries of a checkpoint."""

import pytest

from logvggt_jax.errors import InputError
from logvggt_jax.weights.state_dicts import find_state_dict, plain_names

NAMES = [f"aggregator.blocks.{i}.weight" for i in range(30)] + ["camera_head.norm.bias"]


@pytest.mark.parametrize(
    "prefix",
    [
        *("", "module.", "model.", "_orig_mod.", "net.", "module._orig_mod.", "model.module.", "_orig_mod.net.module."),
        *("_forward_module.", "base_model.model.", "student.", "lit.vggt_model."),
    ],
)
def test_prefixes_come_off_whatever_their_order(prefix):
    assert plain_names([prefix + name for name in NAMES], "file") == {name: prefix + name for name in NAMES}


def test_parts_that_were_compiled_lose_their_mark():
    wrapped = [name.replace("aggregator.", "aggregator._orig_mod.") for name in NAMES]
    assert list(plain_names(wrapped, "file")) == NAMES


def test_what_lacks_the_prefix_of_nearly_all_is_left_out_unless_it_is_the_models():
    names = [f"module.{name}" for name in NAMES]
    with pytest.warns(UserWarning, match="file: 1 tensors outside of the model are left out, first n_averaged"):
        assert list(plain_names(["n_averaged", *names], "file")) == NAMES
    assert "camera_head.scale" in plain_names(["camera_head.scale", *names], "file")


@pytest.mark.parametrize(
    ("model", "average"),
    [("model.", "ema_model."), ("online_model.", "ema_model."), ("student.", "teacher."), ("", "shadow.")],
)
def test_of_a_model_and_its_average_side_by_side_the_model_is_read(model, average):
    names = [before + name for before in (average, model) for name in NAMES]
    with pytest.warns(UserWarning, match=f"holds several models, named '{average}', '{model}'; '{model}' is read"):
        found = plain_names(names, "file")
    assert [found[name] for name in NAMES] == [model + name for name in NAMES]


def test_a_prefix_of_some_stays():
    names = ["model.a", "model.b", "c.d"]
    assert list(plain_names(names, "file")) == names


def test_two_names_of_one_parameter_are_refused():
    with pytest.raises(
        InputError, match=r"file: module\.camera_head\.norm\.bias and camera_head\.norm\.bias are the same"
    ):
        plain_names([f"module.{name}" for name in NAMES] + [NAMES[-1]], "file")


def test_the_model_is_found_by_its_tensors_and_never_in_an_optimizer():
    def is_tensor(value):
        return value == "tensor"

    model = dict.fromkeys(NAMES, "tensor")
    moments = {"exp_avg": dict.fromkeys("abcdef", "tensor")}
    for wrapped in (
        model,
        {"model": model, "optimizer": moments},
        {"checkpoint": {"state_dict": model}, "scale": "tensor"},
        {"anything": model, "epoch": 3},
    ):
        assert find_state_dict(wrapped, is_tensor, "file")[0] is model
    loop = {"epoch": 3}
    loop["self"] = loop
    with pytest.raises(InputError, match=r"file: holds no tensors by name; its entries: epoch \(int\), self"):
        find_state_dict(loop, is_tensor, "file")
