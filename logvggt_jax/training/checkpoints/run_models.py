"""The model folders that a run leaves."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import jax

from logvggt_jax.errors import InputError, OutputExists, disk_errors
from logvggt_jax.files import atomic_folder
from logvggt_jax.model.parameters import unstack_layers
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.weights.checkpoints import check_destination, read_licence, read_provenance, save_model
from logvggt_jax.weights.folder import is_model_folder, read_description
from logvggt_jax.weights.provenance import Provenance, TrainingRecord


class RunModels:
    """The models `<workdir>/model`, of the newest checkpoint, and `<workdir>/best`, of the best validation.

    Attributes:
      newest, best: their folders.
    """

    def __init__(self, workdir: Path, config: TrainConfig, trained_on: Collection[str] | None = None) -> None:
        """Args: `trained_on` are the names of the data sets that are there, None stands for all of `config`."""
        self.newest, self.best = workdir / "model", workdir / "best"
        self._workdir, self._config, self._trained_on = workdir, config, trained_on

    @property
    def best_step(self) -> int | None:
        """The step of the model in `best`; None without one."""
        return _step_of(self.best)

    @property
    def newest_step(self) -> int | None:
        """The step of the model in `model`; None without one."""
        return _step_of(self.newest)

    @property
    def damaged(self) -> list[tuple[Path, InputError]]:
        """Those of the folders that are models whose description cannot be read, each with what is wrong."""
        found: list[tuple[Path, InputError]] = []
        for folder in filter(is_model_folder, (self.newest, self.best)):
            try:
                read_description(folder)
            except InputError as error:
                found.append((folder, error))
        return found

    def check_replaceable(self) -> None:
        """Raises OutputExists where one of the folders is something else than a model, whole or `damaged`; now rather
        than after the steps before the first save."""
        damaged = [folder for folder, _ in self.damaged]
        for folder in (self.newest, self.best):
            if folder not in damaged:
                check_destination(folder)

    def check_own(self) -> None:
        """Raises OutputExists for something else than a whole model, and for a model that another run or a conversion
        wrote, by its provenance."""
        for folder in (self.newest, self.best):
            check_destination(folder)
        for folder in filter(is_model_folder, (self.newest, self.best)):
            source = read_provenance(folder).source or "source not recorded"
            if not source.endswith(self._here):
                raise OutputExists(
                    f"{folder}: a model that this run did not write ({source}) would be replaced; start in another "
                    "--workdir or move it away"
                )

    def write(self, folder: Path, params: Any, step: int) -> None:
        """Replaces one of the folders by these parameters, which are on the host, deep stacks as one."""
        save_model(folder, self._config.model, unstack_layers(params, self._config.model), self._provenance(step))

    def keep_newest_as_best(self) -> None:
        """Replaces `best` by the very files of `model`, which nobody writes to once they are there; by copies where the
        file system has no hard links."""
        with atomic_folder(self.best, replace=True) as fresh, disk_errors(self.best):
            shutil.copytree(self.newest, fresh, copy_function=_linked_or_copied, dirs_exist_ok=True)

    @property
    def _here(self) -> str:
        return f" in {self._workdir}"

    @property
    def _source(self) -> str:
        return f"trained from {self._config.initial_weights or 'random parameters'}{self._here}"

    @functools.cached_property
    def _licence(self) -> str | None:
        """Of the weights that the run started from and of its teacher's, which its own are made of, as far as known."""
        teacher = self._config.teacher
        found: list[str | None] = []
        # Either may be gone, or its hub out of reach, when a run goes on.
        for weights in (self._config.initial_weights, None if teacher is None else teacher.weights):
            with contextlib.suppress(InputError):
                found.append(None if weights is None else read_licence(weights))
        if terms := " and ".join(dict.fromkeys(filter(None, found))):
            return terms
        earlier = read_provenance(self.newest) if is_model_folder(self.newest) else Provenance()
        started_from = None if earlier.training is None else earlier.training.configuration
        ours = self._config.to_dict()
        same = started_from is not None and _made_of(started_from) == _made_of(ours)
        return earlier.licence if same else None

    def _provenance(self, step: int) -> Provenance:
        longer_edge = max(max(size) for stage in self._config.stages for size in stage.sizes)
        named = self._config.data.sources
        used = [source for source in named if self._trained_on is None or source.name in self._trained_on]
        record = TrainingRecord(
            configuration=self._config.to_dict(),
            data=", ".join(f"{source.name} ({source.split})" for source in used),
            steps=step,
            device=f"{jax.device_count()} x {jax.devices()[0].device_kind}",
        )
        return Provenance("windows", longer_edge, self._licence, self._source, record)


def _step_of(folder: Path) -> int | None:
    record = read_provenance(folder).training if is_model_folder(folder) else None
    return None if record is None else record.steps


def _linked_or_copied(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
    return target


def _made_of(configuration: Mapping[str, Any]) -> tuple[Any, Any]:
    """The weights whose licences are the model's: those that a run starts from, and its teacher's."""
    return configuration.get("initial_weights"), (configuration.get("teacher") or {}).get("weights")
