"""Puts a trained model into the package, as the one that ships under a name.

    python scripts/ship_model.py runs/rooms/model rooms --minutes 90 \
        --command "python train.py --config=configs/rooms.py --workdir=runs/rooms"

Writes logvggt_jax/weights/shipped/NAME/: the parameters at 16 bits, and config.json with sizes, provenance and digests.
Refuses a model whose provenance says too little, or that is too large for the package. Steps, configuration, data and
device are what the training run has written down; the model computes in float32 wherever it is loaded, which CPUs like
better and nobody else notices at this size.
"""

from __future__ import annotations

import argparse
import dataclasses
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from logvggt_jax.errors import InputError, one_line
from logvggt_jax.weights import shipped_models
from logvggt_jax.weights.checkpoints import check_destination, load_model, read_provenance, save_rounded_model
from logvggt_jax.weights.provenance import Provenance, TrainingRecord
from logvggt_jax.weights.shipped_models import SHIPPED

LICENCE = "Apache-2.0"
MAX_BYTES = 12_000_000
MAX_CHANGE = 1e-3  # of the parameters by rounding


def ship(folder: Path, name: str, *, command: str, commit: str, minutes: float, steps: int | None = None) -> Path:
    """Writes the model of `folder` as the one that ships under `name`; the folder written.

    Raises InputError where the folder is no sound model, its provenance leaves something open, or it is too large.
    """
    model, variables = load_model(folder)
    config = dataclasses.replace(model.config, dtype="float32")
    provenance = _complete(read_provenance(folder), command=command, commit=commit, minutes=minutes, steps=steps)
    target = shipped_models.ROOT / name
    check_destination(target)
    with tempfile.TemporaryDirectory() as trial:
        change = save_rounded_model(Path(trial) / name, config, variables["params"], provenance)
        size = sum(file.stat().st_size for file in (Path(trial) / name).iterdir())
        if size >= MAX_BYTES:
            raise InputError(f"{folder}: takes {size:,} bytes at 16 bits, expected less than {MAX_BYTES:,}")
        if not change < MAX_CHANGE:
            raise InputError(f"{folder}: rounding to 16 bits changes it by {change:.1e}, expected below {MAX_CHANGE}")
        load_model(Path(trial) / name)
    save_rounded_model(target, config, variables["params"], provenance)
    print(f"{target}: {size:,} bytes; rounding changed the parameters by {change:.1e} of their norm")
    return target


def _complete(provenance: Provenance, *, command: str, commit: str, minutes: float, steps: int | None) -> Provenance:
    record = provenance.training or TrainingRecord()
    configuration = dict(record.configuration or {})
    if "data" in configuration:
        configuration["data"] = {**configuration["data"], "cache_dir": None}  # a path of the machine that trained
    record = dataclasses.replace(
        record,
        command=command,
        commit=commit,
        minutes=minutes,
        steps=record.steps if steps is None else steps,
        configuration=configuration or None,
    )
    start = configuration.get("initial_weights") or "random parameters"
    provenance = dataclasses.replace(
        provenance, licence=LICENCE, source=f"trained from {start} by this package", training=record
    )
    fields = {**dataclasses.asdict(provenance), **dataclasses.asdict(record)}
    if missing := [field for field, value in fields.items() if not value]:
        raise InputError(
            f"the model's provenance does not say {', '.join(missing)}; give a training run's model folder"
        )
    return provenance


def _commit() -> str:
    """The commit of this checkout; InputError where its code is none."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], capture_output=True, text=True, check=True, cwd=root).stdout.strip()

    root = Path(__file__).parents[1]
    if git("status", "--porcelain", "--untracked-files=no", "logvggt_jax", "configs", "train.py"):
        raise InputError(f"{root}: code has changed since the last commit; give the commit of the training as --commit")
    return git("rev-parse", "HEAD")


def main(arguments: Sequence[str] | None = None) -> None:
    """Parses and ships."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="model folder of a training run")
    parser.add_argument("name", choices=SHIPPED)
    parser.add_argument("--command", required=True, help="the training's command")
    parser.add_argument("--minutes", type=float, required=True, help="that the training took")
    parser.add_argument(
        "--steps", type=int, help="of all runs, where several went on from one another; default: the last's"
    )
    parser.add_argument("--commit", help="of the code that trained; default: of this checkout")
    options = parser.parse_args(arguments)
    try:
        commit = options.commit or _commit()
        ship(
            options.folder,
            options.name,
            command=options.command,
            commit=commit,
            minutes=options.minutes,
            steps=options.steps,
        )
    except InputError as error:
        sys.exit(f"ship_model.py: {one_line(error)}")


if __name__ == "__main__":
    main()
