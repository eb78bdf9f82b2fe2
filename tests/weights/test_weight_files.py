"""Finding and opening checkpoint files."""

import json
import os
import struct

import ml_dtypes
import numpy as np
import pytest
from safetensors.numpy import save_file

from logvggt_jax.errors import InputError
from logvggt_jax.weights.files import find_weights, open_state_dict


def test_a_folder_prefers_safetensors(tmp_path, write_torch_file):
    write_torch_file(tmp_path / "model.pt", {"w": np.zeros(1, np.float32)})
    assert find_weights(tmp_path).name == "model.pt"
    save_file({"w": np.ones(1, np.float32)}, tmp_path / "model.safetensors")
    with open_state_dict(tmp_path) as tensors:
        assert tensors["w"] == 1


def test_a_folder_means_its_only_checkpoint_and_of_several_the_user_chooses(tmp_path):
    save_file({"w": np.ones(1, np.float32)}, tmp_path / "vggt_1B_commercial.safetensors")
    assert find_weights(tmp_path).name == "vggt_1B_commercial.safetensors"
    save_file({"w": np.ones(1, np.float32)}, tmp_path / "other.safetensors")
    with pytest.raises(InputError, match=r"several checkpoints, other\.safetensors, vggt_1B_commercial\.safetensors"):
        find_weights(tmp_path)


@pytest.mark.parametrize(
    "beside", ["optimizer.bin", "rng_state.pth", "training_args.bin", "scheduler.pt", "._pytorch_model_fsdp.bin"]
)
def test_what_trainers_and_macos_write_beside_a_model_is_no_second_one(tmp_path, beside):
    for name in ("pytorch_model_fsdp.bin", beside):
        save_file({"w": np.ones(1, np.float32)}, tmp_path / name)
    assert find_weights(tmp_path).name == "pytorch_model_fsdp.bin"


def test_a_distributed_checkpoint_is_named_with_what_makes_one_file_of_it(tmp_path):
    for name in (".metadata", "__0_0.distcp"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=r"distributed checkpoint of PyTorch.*dcp_to_torch"):
        find_weights(tmp_path)


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
def test_both_formats_give_the_same_tensors(tmp_path, write_torch_file, suffix):
    rng = np.random.default_rng(0)
    tensors = {
        "a.weight": rng.standard_normal((2, 3)).astype(np.float32),
        "b.weight": rng.standard_normal(4).astype(ml_dtypes.bfloat16),
        "c.weight": rng.standard_normal(4).astype(np.float16),
    }
    path = tmp_path / f"weights{suffix}"
    if suffix == ".pt":
        write_torch_file(path, tensors)
    else:
        save_file(tensors, path)
    with open_state_dict(path) as found:
        assert set(found) == set(tensors) and len(found) == 3
        assert "a.weight" in found and "d.weight" not in found
        for name, tensor in tensors.items():
            assert found[name].dtype == tensor.dtype
            np.testing.assert_array_equal(found[name], tensor)
        with pytest.raises(KeyError):
            found["d.weight"]


@pytest.mark.parametrize("kept", [0, 4, 40, -4])
def test_a_truncated_safetensors_file_is_an_error(tmp_path, kept):
    path = tmp_path / "model.safetensors"
    save_file({"w": np.zeros(1000, np.float32)}, path)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ValueError, match=r"model\.safetensors.*truncated"), open_state_dict(path):
        pass


def test_paths_that_hold_no_weights_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing: no such file"):
        open_state_dict(tmp_path / "nothing")
    with pytest.raises(FileNotFoundError, match=r"no file of weights .*it holds no file"):
        open_state_dict(tmp_path)
    (tmp_path / "README.md").write_text("x")
    with pytest.raises(FileNotFoundError, match=r"no file of weights \(\.safetensors, .*it holds README\.md"):
        open_state_dict(tmp_path)
    os.mkfifo(tmp_path / "model.pt")
    with pytest.raises(FileNotFoundError, match=r"model\.pt: neither a file nor a folder"):
        open_state_dict(tmp_path / "model.pt")


@pytest.mark.parametrize(
    "name", ["model.pth", "last.ckpt", "pytorch_model.bin", "MODEL.PT", "weights", "model.safetensors"]
)
@pytest.mark.parametrize("torch", [False, True])
def test_the_content_says_what_a_file_is(tmp_path, write_torch_file, name, torch):
    tensors = {"w": np.arange(3, dtype=np.float32)}
    (write_torch_file(tmp_path / name, tensors) if torch else save_file(tensors, tmp_path / name))
    for path in (tmp_path, tmp_path / name):
        with open_state_dict(path) as found:
            np.testing.assert_array_equal(found["w"], tensors["w"])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.", r"PyTorch 1\.6.*torch\.save"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:", "Git LFS.*git lfs pull"),
        (b"\n<!DOCTYPE html><html>404", "web page"),
        (b"\x89HDF\r\n\x1a\n", "HDF5"),
        (b"GGUF\x03\0\0\0", "GGUF"),
        (b"\x08\x07\x12\x07pytorch", "ONNX"),
        (b"x" * 257 + b"ustar", "tar archive.*unpack"),
        (b"\x1f\x8b\x08", "compressed.*unpack"),
        (b"\x93NUMPY\x01", "NumPy array"),
        (b"\0" * 600, "zeros.*interrupted"),
        (b"", "empty"),
        (b"weights of a friend", "begins with b'weights of a fri'"),
        (b'{"error": "not found"}', "JSON text.*weight_map"),
        (b'{"weight_map": ' + b"[" * 100_000, "not valid JSON"),
        (b'{"weight_map": ' + b"9" * 5000, "not valid JSON"),
        (b"PK\x03\x04 and then nothing", "zip archive is truncated"),
    ],
)
def test_what_is_no_checkpoint_is_said(tmp_path, content, words):
    path = tmp_path / "model.pt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught, open_state_dict(path):
        pass
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def _write_shards(folder, write_torch_file, *, torch):
    """Two shards of one tensor each, and their index."""
    weight_map = {}
    suffix, name = ("bin", "pytorch_model") if torch else ("safetensors", "model")
    for i, tensor in enumerate("ab", start=1):
        path = folder / f"{name}-{i:05}-of-00002.{suffix}"
        content = {tensor: np.full(2, i, np.float32)}
        (write_torch_file(path, content) if torch else save_file(content, path))
        weight_map[tensor] = path.name
    index = folder / f"{name}.{suffix}.index.json"
    index.write_text(json.dumps({"metadata": {"total_size": 16}, "weight_map": weight_map}))
    return index


@pytest.mark.parametrize("torch", [False, True])
def test_all_shards_of_an_index_are_read(tmp_path, write_torch_file, torch):
    index = _write_shards(tmp_path, write_torch_file, torch=torch)
    for path in (tmp_path, index):
        with open_state_dict(path) as found:
            assert {name: found[name][0] for name in found} == {"a": 1, "b": 2}
    shard = next(tmp_path.glob("*-00002-*"))
    with pytest.raises(InputError, match="one of several shards"):
        open_state_dict(shard)
    shard.unlink()
    with pytest.raises(FileNotFoundError, match=f"1 of 2 shards are missing, {shard.name}"), open_state_dict(tmp_path):
        pass
    index.unlink()
    with pytest.raises(FileNotFoundError, match="without their index"):
        open_state_dict(tmp_path)


def test_an_index_may_begin_with_a_byte_order_mark(tmp_path, write_torch_file):
    index = _write_shards(tmp_path, write_torch_file, torch=False)
    index.write_text(index.read_text(), encoding="utf-8-sig")
    for path in (tmp_path, index):
        with open_state_dict(path) as found:
            assert set(found) == {"a", "b"}


def test_an_index_that_does_not_fit_is_refused(tmp_path, write_torch_file):
    index = _write_shards(tmp_path, write_torch_file, torch=False)
    good = json.loads(index.read_text())["weight_map"]
    for weight_map, words in (({**good, "c": good["a"]}, "which lacks it"), ({"a": "../a.safetensors"}, r"\.\./a")):
        index.write_text(json.dumps({"weight_map": weight_map}))
        with pytest.raises(InputError, match=words), open_state_dict(index):
            pass


def test_float8_is_refused_with_the_tensors_name(tmp_path):
    header = json.dumps({"w": {"dtype": "F8_E4M3", "shape": [4], "data_offsets": [0, 4]}}).encode()
    (tmp_path / "model.safetensors").write_bytes(struct.pack("<Q", len(header)) + header + bytes(4))
    with open_state_dict(tmp_path) as found, pytest.raises(InputError, match="tensor w is F8_E4M3"):
        found["w"]
