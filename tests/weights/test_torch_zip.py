"""The reader of torch.save files: agrees on layouts, runs no code, and names what is wrong."""

import pickle
import zipfile

import ml_dtypes
import numpy as np
import pytest

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
        ("torch._utils", "_rebuild_parameter"),
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
        "entry 'model' is a dict": write_torch_file(
            tmp_path / "nested.pt", tensors, pickled=b"\x80\x02}X\x05\x00\x00\x00model}s."
        ),
        "persistent id": write_torch_file(tmp_path / "id.pt", tensors, pickled=b"\x80\x02K\x01Q."),
    }
    for words, path in cases.items():
        with pytest.raises(ValueError, match=words) as caught:
            _read_all(path)
        assert path.name in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_are_no_archives_say_how_to_mend(tmp_path):
    legacy, text = tmp_path / "legacy.pt", tmp_path / "text.pt"
    legacy.write_bytes(b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.")
    text.write_text("weights")
    for path, words in ((legacy, r"PyTorch 1\.6.*torch\.save"), (text, r"not a file of torch\.save")):
        with pytest.raises(ValueError, match=words), open_torch_zip(path):
            pass
