"""State dicts in VGGT's form and files as `torch.save` writes them, made without PyTorch."""

import pytest
import torch_files


@pytest.fixture(scope="session")
def vggt_config():
    """VGGT's depth of 24, which its key layers need, at the smallest widths."""
    return torch_files.small_vggt_config()


@pytest.fixture(scope="session")
def random_state_dict():
    """Random tensors for a configuration, two tensors of a track head included: `random_state_dict(config)`."""
    return torch_files.random_state_dict


@pytest.fixture(scope="session")
def vggt_state_dict(vggt_config, random_state_dict):
    """A state dict for `vggt_config`."""
    return random_state_dict(vggt_config)


@pytest.fixture(scope="session")
def write_torch_file():
    """Writes a file of torch.save: `write(path, content, pickled=None, byteorder=b"little", compression=ZIP_STORED)`.

    `content` maps names to arrays, `write.view`s, numbers, texts, lists, `write.instance`s and mappings of these; equal
    storages are stored once. `pickled` replaces the pickle.
    """
    write = torch_files.write_torch_file
    write.view, write.instance = torch_files.View, torch_files.Instance
    return write
