"""What killed runs left half-written in a run's own folder goes when the next one has it."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from logvggt_jax.errors import InputError, disk_errors
from logvggt_jax.files import FolderLock

# Where `--preflight` writes its checkpoint, within the work folder; no run is given this name.
PREFLIGHT = ".preflight.partial"


def remove_scratch(workdir: Path) -> None:
    """Removes what killed saves left in `workdir`, models and checkpoints under temporary names, and what a killed
    preflight did.

    A model that was moved aside for a new one which never came takes its place again. The caller has the folder's lock.
    """
    checkpoints = workdir / "checkpoints"
    half = [*checkpoints.glob("*.partial"), *checkpoints.glob(".*.old")]
    for model in (workdir / "model", workdir / "best"):
        aside = sorted(workdir.glob(f".{model.name}.*.old"), key=lambda path: path.stat().st_mtime)
        with disk_errors(model):
            if aside and not model.exists():
                aside.pop().rename(model)
        half += [*aside, *workdir.glob(f"{model.name}.*.partial")]
    if (workdir / PREFLIGHT / ".lock").is_file():
        with contextlib.suppress(InputError):  # of one that is still at work
            FolderLock(workdir / PREFLIGHT, "wait").release()
            half.append(workdir / PREFLIGHT)
    for path in half:
        shutil.rmtree(path, ignore_errors=True)
