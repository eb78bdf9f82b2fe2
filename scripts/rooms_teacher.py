"""Writes the model that ships as a teacher, for `configs/distill_rooms.py`.

    python scripts/rooms_teacher.py runs/teacher

Teachers are plain VGGT: all frames of a clip see one another. The model that ships was trained on windows, and its
provenance says so. Its parts with one window over all frames are plain VGGT too, on rooms as good in depth as with its
own windows and worse in position (`offline` beside `windows` in docs/methods.md), which makes it the teacher that is at
hand without downloads. The folder written says that it is to be used so; an existing one is never replaced.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from logvggt_jax.errors import InputError, one_line
from logvggt_jax.weights.checkpoints import load_model, read_provenance, save_model

NAME = "rooms"


def write_teacher(folder: Path) -> None:
    """Raises OutputExists where `folder` exists."""
    model, variables = load_model(NAME)
    provenance = dataclasses.replace(read_provenance(NAME), trained_for="vggt", source=f"{NAME}, trained on windows")
    save_model(folder, model.config, variables["params"], provenance, replace=False)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parses and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the model folder to write")
    options = parser.parse_args(arguments)
    try:
        write_teacher(options.folder)
    except InputError as error:
        sys.exit(f"rooms_teacher.py: {one_line(error)}")


if __name__ == "__main__":
    main()
