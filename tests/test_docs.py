"""The Python examples of docs/jax.md and of the README run as they stand, one after the other."""

import functools
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import logvggt_jax
from logvggt_jax import LogVGGT, ModelConfig

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def ran(small_config: ModelConfig, small_variables: dict) -> dict[str, Any]:
    """The names that the blocks leave; with a small model in place of the one that ships."""
    blocks = _blocks(ROOT / "docs" / "jax.md")
    assert len(blocks) > 7
    names: dict[str, Any] = {}
    cache = jax.config.jax_compilation_cache_dir
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logvggt_jax, "load_model", lambda _: (LogVGGT(small_config), jax.device_put(small_variables)))
        for block in blocks:
            exec(compile(block, "docs/jax.md", "exec"), names)
    jax.config.update("jax_compilation_cache_dir", cache)
    return names


def _blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)


@pytest.mark.slow
def test_the_readmes_examples_agree(small_config: ModelConfig, small_variables: dict[str, Any]) -> None:
    whole, stream, split = _blocks(ROOT / "README.md")
    names: dict[str, Any] = {"frames": np.random.default_rng(0).integers(0, 256, (4, 32, 45, 3), np.uint8)}
    model = LogVGGT(small_config), jax.device_put(small_variables)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logvggt_jax, "load_model", lambda _: model)
        patch.setattr(logvggt_jax, "preprocess", functools.partial(logvggt_jax.preprocess, longer_edge=42))
        exec(whole, names)
    expected = names["predictions"]
    assert names["points"].shape == (*expected.depth.shape, 3)
    exec(stream, names)
    np.testing.assert_allclose(names["poses"][:, :, -1], expected.pose_encoding, rtol=1e-4, atol=2e-5)
    names["clip"] = np.repeat(names["clip"], jax.device_count(), axis=0)
    exec(split, names)
    np.testing.assert_allclose(names["predictions"].depth[-1:], expected.depth, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_stream_in_ones_own_loop_gives_the_numbers_of_one_call(ran: dict[str, Any]) -> None:
    whole = ran["apply"](ran["variables"], ran["images"])
    np.testing.assert_allclose(ran["encodings"][:, :, -1], whole.pose_encoding, rtol=1e-4, atol=2e-5)


@pytest.mark.slow
def test_vmap_is_the_batch(ran: dict[str, Any]) -> None:
    expected = jax.jit(ran["model"].apply)(ran["variables"], ran["images"][:2, :2]).depth
    np.testing.assert_allclose(ran["several"], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_gradients_reach_images_and_parameters(ran: dict[str, Any]) -> None:
    assert np.abs(ran["of_images"]).max() > 0
    heads = jax.tree.leaves(ran["of_parameters"]["params"]["depth_head"])
    assert all(np.isfinite(leaf).all() for leaf in heads) and max(np.abs(leaf).max() for leaf in heads) > 0


@pytest.mark.slow
def test_every_way_to_split_a_batch_gives_its_numbers(ran: dict[str, Any]) -> None:
    whole = ran["apply"](ran["variables"], ran["images"])
    explicit = ran["apply"](ran["everywhere"], ran["split"])
    for found in (explicit, jax.jit(ran["sharded"])(ran["variables"], ran["images"])):
        np.testing.assert_allclose(found.depth, whole.depth, rtol=1e-4, atol=1e-5)
        assert len(found.depth.sharding.device_set) == 4


@pytest.mark.slow
def test_the_exported_program_runs_without_this_package(ran: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "program").write_bytes(ran["stored"])
    leaves = jax.tree.leaves(ran["variables"])
    np.savez(tmp_path / "arrays.npz", *leaves, images=ran["images"][:1, :2], depth=ran["depths"])
    script = """
import sys
import jax, numpy as np
from jax import export
program = export.deserialize(open("program", "rb").read())
arrays = np.load("arrays.npz")
leaves = [arrays[f"arr_{i}"] for i in range(len(arrays.files) - 2)]
_, _, depth = program.call(*jax.tree.unflatten(program.in_tree, [*leaves, arrays["images"]])[0])
np.testing.assert_allclose(depth, arrays["depth"], rtol=1e-5, atol=1e-6)
assert "cuda" in program.platforms and not any(name.startswith("logvggt") for name in sys.modules)
"""
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, timeout=120)


@pytest.mark.parametrize(
    ("scale", "shift", "mend"), [(255.0, 0.0, "give uint8"), (1.0, -0.5, "give uint8"), (np.nan, 0.0, "may be NaN")]
)
def test_floating_point_images_beyond_one_are_refused_outside_of_jit(
    small_config: ModelConfig, small_variables: dict, scale: float, shift: float, mend: str
) -> None:
    images = scale * np.random.default_rng(0).random((1, 2, 28, 42, 3), np.float32) + np.float32(shift)
    with pytest.raises(ValueError, match=rf"images must be floating point in \[0, 1\], got values from .*{mend}"):
        LogVGGT(small_config).apply(small_variables, images)
