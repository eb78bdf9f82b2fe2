"""Finding and opening checkpoint files."""

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
    other = tmp_path / "model.ckpt"
    other.write_bytes(b"x")
    with pytest.raises(FileNotFoundError, match=r"nothing: no such file"):
        open_state_dict(tmp_path / "nothing")
    with pytest.raises(FileNotFoundError, match=r"holds no \.safetensors or \.pt file"):
        open_state_dict(tmp_path)
    with pytest.raises(ValueError, match=r"unknown suffix '\.ckpt'"):
        open_state_dict(other)
