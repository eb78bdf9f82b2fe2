"""A run's own folder: one run at a time uses it, and what killed ones left half-written goes."""

from __future__ import annotations

import fcntl
import os
import platform
import shutil
from pathlib import Path
from typing import IO

from absl import logging

from logvggt_jax.errors import InputError, disk_errors


class FolderLock:
    """The exclusive use of a folder, which ends with the process that has it, however that ends."""

    def __init__(self, folder: Path) -> None:
        """Raises InputError where another run has the folder, DiskError where it cannot be written."""
        path = folder / ".lock"
        with disk_errors(path):
            folder.mkdir(parents=True, exist_ok=True)
            # Closed when a process is started from this one: a reading process that outlives a run has no lock.
            self._file: IO[str] = path.open("a+")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._file.seek(0)
            owner = self._file.read().strip() or "unknown"
            self._file.close()
            raise InputError(
                f"{folder}: another run is using this folder ({owner}); wait until it has ended or start in another "
                "--workdir"
            ) from error
        except OSError as error:  # some network file systems
            logging.warning("%s: cannot be locked (%s); take care that no other run uses it", folder, error)
            return
        self._file.truncate(0)
        self._file.write(f"process {os.getpid()} on {platform.node()}\n")
        self._file.flush()

    def release(self) -> None:
        """Lets others have the folder."""
        self._file.close()


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
