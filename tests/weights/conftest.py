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
    """`torch_files.write_torch_file`, with its `view` and `instance`."""
    torch_files.write_torch_file.view = torch_files.View
    torch_files.write_torch_file.instance = torch_files.Instance
    return torch_files.write_torch_file
