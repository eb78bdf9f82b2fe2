"""What the benchmarks of whole streams measure: a model folder's model, or that of configs/tiny.py."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

# What is measured is this checkout.
sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import jax.numpy as jnp

from configs import tiny
from logvggt_jax import LogVGGT, ModelConfig, load_model


def tiny_configuration() -> dict[str, Any]:
    """What configs/tiny.py says."""
    return tiny.get_config().to_dict()


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options that `subject` reads."""
    parser.add_argument("--checkpoint", type=Path, help="model folder; default configs/tiny.py's model, random")
    parser.add_argument("--image-size", type=_size, default=(56, 70), metavar="HxW", help="default 56x70")
    parser.add_argument("--dtype", choices=("float32", "bfloat16"), help="compute type instead of the model's own")


def subject(options: argparse.Namespace) -> tuple[LogVGGT, dict[str, Any]]:
    """The model that the options name and its variables; random ones where they name none."""
    if options.checkpoint is None:
        config, variables = ModelConfig.from_dict(tiny_configuration()["model"]), None
    else:
        loaded, variables = load_model(options.checkpoint)
        config = loaded.config
    model = LogVGGT(dataclasses.replace(config, dtype=options.dtype or config.dtype))
    if variables is None:
        variables = model.init(jax.random.key(0), jnp.zeros((1, 1, *options.image_size, 3), jnp.uint8))
    return model, variables


def _size(text: str) -> tuple[int, int]:
    height, separator, width = text.partition("x")
    if not (separator and height.isdecimal() and width.isdecimal()) or int(height) % 14 or int(width) % 14:
        raise argparse.ArgumentTypeError(f"expected height x width in multiples of 14 such as 56x70, got {text!r}")
    return int(height), int(width)
