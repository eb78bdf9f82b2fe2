"""Writes a model of twice as many blocks that computes what a model folder's does, for training to go on from.

    python scripts/deepen_model.py runs/rooms/model runs/rooms-deep

The new folder says that it comes from the old one; the old one stays. `configs/rooms.py:FOLDER` and
`configs/finetune.py:FOLDER` take sizes from the folder that they start from.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from logvggt_jax.errors import InputError, one_line
from logvggt_jax.weights.checkpoints import load_model, read_provenance, save_model
from logvggt_jax.weights.deepening import deepened


def write_deeper(source: str, folder: Path) -> None:
    """Raises InputError where `source` is no model folder, OutputExists where `folder` exists."""
    model, variables = load_model(source)
    config, params = deepened(model.config, variables["params"])
    provenance = dataclasses.replace(read_provenance(source), source=f"{source}, with twice as many blocks")
    save_model(folder, config, params, provenance, replace=False)
    print(
        f"{folder}: {config.encoder.depth} blocks in the encoder, {config.aggregator.depth} pairs in the aggregator, "
        f"key layers {', '.join(map(str, config.aggregator.key_layers))}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Parses and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="a model folder, or the name of a model that ships")
    parser.add_argument("folder", type=Path, help="the model folder to write")
    options = parser.parse_args(arguments)
    try:
        write_deeper(options.source, options.folder)
    except InputError as error:
        sys.exit(f"deepen_model.py: {one_line(error)}")


if __name__ == "__main__":
    main()
