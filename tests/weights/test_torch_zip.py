"""The reader of torch.save files: agrees on layouts, runs no code, and names what is wrong."""

import pickle
import zipfile

import ml_dtypes
import numpy as np
import pytest

from logvggt_jax.errors import InputError
from logvggt_jax.weights.torch_zip import open_torch_zip


def _read_all(path):
    with open_torch_zip(path) as tensors:
        return {name: np.array(tensors[name]) for name in tensors}


def _without(good, cut):
    """A copy of an archive whose storages are cut to so many bytes, or are not there."""
    bad = good.with_name("bad.pt")
    with zipfile.ZipFile(good) as source, zipfile.ZipFile(bad, "w") as archive:
        for name in source.namelist():
            if "/data/" not in name:
                archive.writestr(name, source.read(name))
            elif cut:
                archive.writestr(name, source.read(name)[:cut])
    return bad


def _altered_tensor():
    """A pickle that makes a tensor of four values, then gives it a shape that reaches beyond its storage."""
    storage = b"(X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\x000X\x03\0\0\0cpuK\x04tQ"
    tensor = b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + b"K\0K\x04\x85K\x01\x85\x89}tR"
    return b"\x80\x02}X\x01\0\0\0w" + tensor + b"}X\x05\0\0\0shapeM\x00\x40\x85sbs."


def test_tensors_come_back_in_shape_type_and_value(tmp_path, write_torch_file):
    rng = np.random.default_rng(0)
    tensors = {
        "weight": rng.standard_normal((3, 5)).astype(np.float32),
        "half": rng.standard_normal(7).astype(np.float16),
        "brain": rng.standard_normal((2, 2)).astype(ml_dtypes.bfloat16),
        "count": np.array(7, np.int64),
        "empty": np.zeros((0, 3), np.float32),
    }
    found = _read_all(write_torch_file(tmp_path / "model.pt", tensors))
    assert list(found) == list(tensors)
    for name, tensor in tensors.items():
        assert found[name].dtype == tensor.dtype
        np.testing.assert_array_equal(found[name], tensor)


def test_views_follow_offset_and_strides_of_a_shared_storage(tmp_path, write_torch_file):
    storage = np.arange(24, dtype=np.float32)
    rows = storage.reshape(4, 6)
    path = write_torch_file(
        tmp_path / "model.pt",
        {
            "transposed": write_torch_file.view(storage, 0, (6, 4), (1, 6)),
            "tail": write_torch_file.view(storage, 20, (4,), (1,)),
            "columns": write_torch_file.view(storage, 1, (4, 3), (6, 2)),
        },
    )
    with zipfile.ZipFile(path) as archive:
        assert sum("/data/" in name for name in archive.namelist()) == 1
    found = _read_all(path)
    np.testing.assert_array_equal(found["transposed"], rows.T)
    np.testing.assert_array_equal(found["tail"], [20, 21, 22, 23])
    np.testing.assert_array_equal(found["columns"], rows[:, 1::2])


def test_code_in_the_pickle_is_refused_by_name_and_never_runs(tmp_path, write_torch_file):
    target = tmp_path / "ran"
    command = f"touch {target}".encode()
    code = b"\x80\x02cposix\nsystem\n(U" + bytes([len(command)]) + command + b"tR."
    path = write_torch_file(tmp_path / "model.pt", {}, pickled=code)
    with pytest.raises(ValueError, match=r"model\.pt.*posix\.system.*safetensors"), open_torch_zip(path):
        pass
    assert not target.exists()
    pickle.loads(code)  # the same bytes do run under the plain unpickler
    assert target.exists()


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("builtins", "eval"),
        ("builtins", "getattr"),
        ("torch", "load"),
        ("collections", "defaultdict"),
        ("numpy._core.multiarray", "_reconstruct"),
        ("torch._utils", "_rebuild_tensor_v2.__call__"),
    ],
)
@pytest.mark.parametrize("protocol", [2, 4])
def test_other_names_are_refused(tmp_path, write_torch_file, module, name, protocol):
    if protocol == 2:
        code = f"c{module}\n{name}\n.".encode()
    else:  # STACK_GLOBAL, which also resolves dotted names
        short = [b"\x8c" + bytes([len(text)]) + text.encode() for text in (module, name)]
        code = b"".join(short) + b"\x93."
    path = write_torch_file(tmp_path / "model.pt", {}, pickled=bytes([0x80, protocol]) + code)
    with pytest.raises(ValueError, match=rf"refused {module}\.{name}"), open_torch_zip(path):
        pass


@pytest.mark.parametrize(
    ("offset", "shape", "strides"),
    [(0, (7,), (1,)), (4, (3,), (1,)), (0, (2, 2), (5, 1)), (0, (3,), (-1,)), (0, (10**9,), (0,)), (0, (2, 2), (1,))],
)
def test_a_view_beyond_its_storage_is_refused(tmp_path, write_torch_file, offset, shape, strides):
    view = write_torch_file.view(np.zeros(6, np.float32), offset, shape, strides)
    path = write_torch_file(tmp_path / "model.pt", {"weight": view})
    with pytest.raises(ValueError, match=r"model\.pt"), open_torch_zip(path):
        pass


def test_a_storage_shorter_than_announced_names_the_tensor(tmp_path, write_torch_file):
    good = write_torch_file(tmp_path / "model.pt", {"w": np.zeros(4, np.float32)})
    with (
        open_torch_zip(_without(good, 12)) as tensors,
        pytest.raises(ValueError, match=r"bad\.pt: tensor w: .*12 bytes"),
    ):
        tensors["w"]


@pytest.mark.parametrize("kept", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_an_error(tmp_path, write_torch_file, kept):
    path = write_torch_file(tmp_path / "model.pt", {"w": np.arange(4000, dtype=np.float32)})
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(ValueError, match=r"model\.pt.*truncated"):
        _read_all(path)


def test_a_flipped_byte_of_a_storage_is_an_error(tmp_path, write_torch_file):
    weight = np.arange(4000, dtype=np.float32)
    path = write_torch_file(tmp_path / "model.pt", {"w": weight})
    data = bytearray(path.read_bytes())
    data[data.index(weight.tobytes()) + 8000] ^= 0x40
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"CRC.*damaged"):
        _read_all(path)


def test_a_missing_storage_is_an_error(tmp_path, write_torch_file):
    good = write_torch_file(tmp_path / "model.pt", {"w": np.zeros(4, np.float32)})
    with pytest.raises(ValueError, match=r"bad\.pt: model/data/0 is missing"):
        _read_all(_without(good, 0))


def test_what_torch_would_not_write_is_refused(tmp_path, write_torch_file):
    tensors = {"w": np.zeros(4, np.float32)}
    cases = {
        "byte order": write_torch_file(tmp_path / "big.pt", tensors, byteorder=b"big"),
        "compressed": write_torch_file(tmp_path / "small.pt", tensors, compression=zipfile.ZIP_DEFLATED),
        "damaged": write_torch_file(tmp_path / "cut.pt", tensors, pickled=b"\x80\x02}(X\x05"),
        "holds a int": write_torch_file(tmp_path / "int.pt", tensors, pickled=b"\x80\x02K\x01."),
        r"holds no tensors by name; its entries: model \(0 entries\), epoch \(int\)": write_torch_file(
            tmp_path / "nested.pt", {"model": {}, "epoch": 3}
        ),
        r"beside its tensors the state dict holds epoch \(int\)": write_torch_file(
            tmp_path / "flat.pt", {**tensors, "epoch": 3}
        ),
        "altered after it was made": write_torch_file(tmp_path / "altered.pt", tensors, pickled=_altered_tensor()),
        "persistent id": write_torch_file(tmp_path / "id.pt", tensors, pickled=b"\x80\x02K\x01Q."),
    }
    for words, path in cases.items():
        with pytest.raises(ValueError, match=words) as caught:
            _read_all(path)
        assert path.name in str(caught.value) and "\n" not in str(caught.value)


def test_archives_of_other_kinds_say_what_they_are(tmp_path, write_torch_file):
    np.savez(tmp_path / "weights.npz", w=np.zeros(3))
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as archive:
        archive.writestr("holiday.jpg", b"x")
    script = write_torch_file(tmp_path / "script.pt", {"w": np.zeros(3, np.float32)})
    with zipfile.ZipFile(script, "a") as archive:
        archive.writestr("script/constants.pkl", b"\x80\x02).")
    cases = {"weights.npz": "archive of NumPy arrays", "photos.zip": "holiday.jpg", "script.pt": "TorchScript program"}
    for name, words in cases.items():
        with pytest.raises(InputError, match=words), open_torch_zip(tmp_path / name):
            pass


def test_a_trainers_checkpoint_gives_its_model_and_runs_nothing(tmp_path, write_torch_file):
    settings = write_torch_file.instance("argparse", "Namespace", {"lr": 1e-4, "output": "runs"})
    evil = write_torch_file.instance("subprocess", "Popen", {"args": "touch ran"})
    weights = {"a.weight": np.arange(6, dtype=np.float32).reshape(2, 3), "a.bias": np.ones(2, np.float32)}
    moments = {"state": {"0": {"exp_avg": np.zeros(6, np.float32)}}, "param_groups": [{"lr": 1e-4}]}
    content = {"epoch": 3, "args": settings, "hook": evil, "optimizer": moments, "model": weights, "best": 0.5}
    path = write_torch_file(tmp_path / "checkpoint.pth", content)
    found = _read_all(path)
    assert list(found) == list(weights)
    np.testing.assert_array_equal(found["a.weight"], weights["a.weight"])
    with open_torch_zip(path) as tensors:
        assert (
            "'model' of the entries epoch (int), args (argparse.Namespace), hook (subprocess.Popen)" in tensors.origin
        )


def test_an_object_among_the_weights_is_refused_by_name(tmp_path, write_torch_file):
    other = write_torch_file.instance("torch.nn.modules.linear", "Linear", {"in_features": 3})
    weights = {"a.weight": np.ones(3, np.float32), "a.layer": other}
    path = write_torch_file(tmp_path / "model.pt", {"state_dict": weights})
    with (
        pytest.raises(InputError, match=r"holds a\.layer \(torch\.nn\.modules\.linear\.Linear\)"),
        open_torch_zip(path),
    ):
        pass
    whole = write_torch_file(tmp_path / "whole.pt", {"model": other, "epoch": 3})
    with pytest.raises(InputError, match=r"its entries: model \(torch\.nn\.modules\.linear\.Linear\), epoch"):
        _read_all(whole)


def test_of_a_model_and_its_average_the_model_is_read_with_a_warning(tmp_path, write_torch_file):
    one, two = ({"w": np.full(3, value, np.float32)} for value in (1, 2))
    path = write_torch_file(tmp_path / "ema.pt", {"ema": two, "model": one})
    with pytest.warns(UserWarning, match="several state dicts, 'ema', 'model'; 'model' is read"):
        assert _read_all(path)["w"][0] == 1
    # Alone, it is what there is.
    assert _read_all(write_torch_file(tmp_path / "alone.pt", {"model_ema": two}))["w"][0] == 2


@pytest.mark.parametrize("rebuild", ["_rebuild_parameter", "_rebuild_parameter_with_state"])
def test_parameters_are_their_tensors(tmp_path, write_torch_file, rebuild):
    plain = write_torch_file(tmp_path / "plain.pt", {"w": np.arange(3, dtype=np.float32)})
    with zipfile.ZipFile(plain) as archive:
        pickled = archive.read("plain/data.pkl")
    tensor = pickled[pickled.index(b"ctorch._utils") : pickled.index(b"u}X")]
    arguments = b"(" + tensor + b"\x88" + b"}" + (b"}" if rebuild.endswith("state") else b"") + b"t"
    wrapped = pickled.replace(tensor, f"ctorch._utils\n{rebuild}\n".encode() + arguments + b"R")
    path = write_torch_file(tmp_path / "wrapped.pt", {"w": np.arange(3, dtype=np.float32)}, pickled=wrapped)
    np.testing.assert_array_equal(_read_all(path)["w"], [0, 1, 2])


def test_types_that_are_not_read_name_the_tensor_when_it_is_asked_for(tmp_path, write_torch_file):
    # As torch.save writes float8: bytes without a type, and the type beside them.
    storage = b"(X\x07\0\0\0storagectorch.storage\nUntypedStorage\nX\x01\0\0\x000X\x03\0\0\0cpuK\x02tQ"
    arguments = b"(" + storage + b"K\0K\x02\x85K\x01\x85\x89}ctorch\nfloat8_e4m3fn\nt"
    float8 = b"X\x01\0\0\0wctorch._utils\n_rebuild_tensor_v3\n" + arguments + b"R"
    path = write_torch_file(
        tmp_path / "model.pt", {"w": np.zeros(2, np.float32)}, pickled=b"\x80\x02}(" + float8 + b"u."
    )
    with open_torch_zip(path) as tensors, pytest.raises(InputError, match=r"tensor w is float8_e4m3fn.*bfloat16"):
        tensors["w"]


def test_damage_anywhere_is_an_error_with_the_file_or_has_no_effect(tmp_path, write_torch_file):
    tensors = {"a.weight": np.arange(12, dtype=np.float32).reshape(3, 4), "a.bias": np.ones(4, np.float16)}
    settings = write_torch_file.instance("argparse", "Namespace", {"lr": 0.5})
    path = write_torch_file(tmp_path / "model.pt", {"model": tensors, "args": settings})
    good, rng, refused = path.read_bytes(), np.random.default_rng(0), 0
    for i in range(1500):
        bad = bytearray(good)
        if i % 3:
            bad[rng.integers(len(bad))] ^= 1 << rng.integers(8)
        else:
            start = rng.integers(len(bad))
            bad[start : start + rng.integers(1, 40)] = rng.bytes(rng.integers(40))
        path.write_bytes(bad)
        try:
            _read_all(path)
        except InputError as error:
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
            refused += 1
    assert refused > 1000
