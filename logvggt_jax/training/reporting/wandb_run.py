"""A run's scalars and pictures on Weights & Biases, beside TensorBoard; the library is optional."""

from __future__ import annotations

import importlib
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from absl import logging

from logvggt_jax.errors import InputError, MissingPackage, install_line, one_line
from logvggt_jax.files import write_text

_ID_FILE = "wandb_id"


class WandbRun:
    """One run of `project`, which goes on when the work folder's run does; a context manager.

    With WANDB_MODE=offline nothing leaves the machine, and `wandb sync` sends it later. Steps that were sent before a
    run was killed are not sent again: they come to the same numbers.

    Raises:
      MissingPackage: the library is not installed.
      InputError: a run cannot be begun there; says how to mend it.
    """

    def __init__(self, project: str, workdir: Path, settings: Mapping[str, Any]) -> None:
        self._wandb = load_wandb()
        known = workdir / _ID_FILE
        workdir.mkdir(parents=True, exist_ok=True)
        if not known.exists():
            write_text(known, secrets.token_hex(8))
        try:
            self._run = self._wandb.init(
                project=project,
                name=workdir.absolute().name,
                dir=str(workdir),
                id=known.read_text().strip(),
                resume="allow",
                config=dict(settings),
            )
        except Exception as error:  # the library's own kinds, and those of its network
            raise InputError(
                f"--wandb={project}: no run can be begun ({one_line(error):.200}); `wandb login`, or set "
                "WANDB_MODE=offline"
            ) from error

    def __enter__(self) -> WandbRun:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._run.finish(exit_code=0 if kind is None else 1)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Sends scalars."""
        self._log(step, values)

    def show(self, step: int, pictures: Mapping[str, np.ndarray]) -> None:
        """Sends pictures, [h, w, 3] uint8 RGB."""
        self._log(step, {name: self._wandb.Image(picture) for name, picture in pictures.items()})

    def _log(self, step: int, values: Mapping[str, Any]) -> None:
        try:
            self._run.log(dict(values), step=step)
        except Exception as error:  # A service that is away for an hour is no reason to end a week's run.
            logging.warning("step %d is not on Weights & Biases: %s", step, one_line(error))


def load_wandb() -> Any:
    """The library; MissingPackage where it is not installed."""
    try:
        return importlib.import_module("wandb")
    except ImportError as error:
        raise MissingPackage(f"--wandb needs a library that is not installed: {install_line('wandb')}") from error
