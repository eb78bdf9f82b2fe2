"""What killed runs left half-written in a run's own folder goes when the next one has it."""

from __future__ import annotations

import shutil
from pathlib import Path

from logvggt_jax.errors import disk_errors


def remove_scratch(workdir: Path) -> None:
    """Removes what killed saves left in `workdir`: models and checkpoints under temporary names.

    A model that was moved aside for a new one which never came takes its place again. The caller has the folder's lock.
    """
    model, checkpoints = workdir / "model", workdir / "checkpoints"
    aside = sorted(workdir.glob(".model.*.old"), key=lambda path: path.stat().st_mtime)
    with disk_errors(model):
        if aside and not model.exists():
            aside.pop().rename(model)
    half = [*workdir.glob("model.*.partial"), *checkpoints.glob("*.partial"), *checkpoints.glob(".*.old")]
    for path in (*aside, *half):
        shutil.rmtree(path, ignore_errors=True)
