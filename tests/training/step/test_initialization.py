"""Parameters that a run starts from are the host's until their places on the devices are known."""

from __future__ import annotations

import contextlib
from typing import Any

import jax
import numpy as np
import pytest

from logvggt_jax import ModelConfig
from logvggt_jax.training.step import initialization
from logvggt_jax.training.step.initialization import initial_parameters
from logvggt_jax.weights.address import resolve
from logvggt_jax.weights.checkpoints import load_model, read_config


@pytest.mark.parametrize("weights", [None, "rooms"])
def test_where_the_accelerators_are_alone_the_first_of_them_gets_no_stack_and_no_weights(
    weights: str | None, small_config: ModelConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the host as a device, what JAX makes lies on the first accelerator."""
    config = small_config if weights is None else read_config(resolve(weights))
    stack, seen = initialization.stack_layers, list[tuple[set[type], set[type]]]()

    def look(params: Any) -> Any:
        stacked = stack(params)
        before, after = ({type(leaf) for leaf in jax.tree.leaves(tree)} for tree in (params, stacked))
        seen.append((before, after))
        return stacked

    monkeypatch.setattr(initialization, "_on_host", contextlib.nullcontext)
    monkeypatch.setattr(initialization, "stack_layers", look)
    params = initial_parameters(config, seed=0, weights=weights)
    assert seen == [({np.ndarray}, {np.ndarray})]
    if weights is None:
        return
    monkeypatch.undo()
    expected = stack(jax.device_get(load_model(resolve(weights))[1]["params"]))
    jax.tree.map(np.testing.assert_array_equal, params, expected)
