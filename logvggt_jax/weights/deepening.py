"""A model of twice as many blocks that computes what the old one does, to be trained on."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from logvggt_jax.config import ModelConfig

# The last layer of each branch of a block; where it gives nothing, the block passes on what it gets.
_LAST = (("attention", "output"), ("mlp", "fc2"))


def deepened(config: ModelConfig, params: dict[str, Any]) -> tuple[ModelConfig, dict[str, Any]]:
    """Puts before each block of encoder and aggregator a copy of it that adds nothing yet.

    The copies' last layers are 0, so that depth and cameras stay as they were; gradients reach these layers at once,
    and through them the rest. Key layers stay the same blocks, under other numbers.

    Args:
      config: of the model.
      params: its parameters, `variables["params"]`, block by block.

    Returns:
      The configuration and parameters of the deeper model.
    """
    encoder, aggregator = config.encoder, config.aggregator
    deeper = dataclasses.replace(
        config,
        encoder=dataclasses.replace(encoder, depth=2 * encoder.depth),
        aggregator=dataclasses.replace(
            aggregator,
            depth=2 * aggregator.depth,
            key_layers=tuple(2 * layer + 1 for layer in aggregator.key_layers),
        ),
    )
    return deeper, {
        **params,
        "encoder": _doubled(params["encoder"], ("block",), encoder.depth),
        "aggregator": _doubled(params["aggregator"], ("frame_block", "global_block"), aggregator.depth),
    }


def _doubled(part: dict[str, Any], kinds: tuple[str, ...], depth: int) -> dict[str, Any]:
    blocks = {f"{kind}_{number}" for kind in kinds for number in range(depth)}
    doubled = {name: leaf for name, leaf in part.items() if name not in blocks}
    for kind in kinds:
        for number in range(depth):
            block = part[f"{kind}_{number}"]
            doubled[f"{kind}_{2 * number}"], doubled[f"{kind}_{2 * number + 1}"] = _idle(block), block
    return doubled


def _idle(block: dict[str, Any]) -> dict[str, Any]:
    copy = {name: dict(part) for name, part in block.items()}
    for branch, layer in _LAST:
        copy[branch][layer] = {name: np.zeros_like(leaf) for name, leaf in block[branch][layer].items()}
    return copy
