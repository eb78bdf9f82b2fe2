"""A trace of some steps, for xprof or TensorBoard."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
from absl import logging

from logvggt_jax.errors import InputError, one_line


class ProfiledSteps(NamedTuple):
    """Steps `first` to `last` of a run, counted from 1."""

    first: int
    last: int

    @classmethod
    def parse(cls, text: str) -> ProfiledSteps:
        """From "20:25"; InputError for anything else."""
        found = re.fullmatch(r"([1-9]\d*):([1-9]\d*)", text)
        if found is None or int(found[1]) > int(found[2]):
            raise InputError(f"--profile={text}: expected the first and the last step, such as 20:25")
        return cls(int(found[1]), int(found[2]))


class Profiler:
    """Writes the trace of this process's `steps` to `folder`; a context manager that ends a trace with its run, and
    warns where the run ended without one of them."""

    def __init__(self, steps: ProfiledSteps | None, folder: Path) -> None:
        self._steps, self._folder, self._running = steps, folder, False

    def __enter__(self) -> Profiler:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._running:
            self.stop()
        elif self._steps is not None and kind is None:
            logging.warning(
                "no trace in %s: none of the steps %d to %d was made in this start", self._folder, *self._steps
            )

    def before(self, step: int) -> None:
        """Begins the trace with its first step, or with the first that is left where a run goes on among them."""
        if self._steps is not None and not self._running and self._steps.first <= step <= self._steps.last:
            with self._forgiven():
                jax.profiler.start_trace(self._folder)
                self._running = True

    def is_last(self, step: int) -> bool:
        """Whether the trace is to end with this step, once it has finished."""
        return self._running and self._steps is not None and step >= self._steps.last

    def stop(self) -> None:
        """Ends the trace."""
        with self._forgiven():
            jax.profiler.stop_trace()
        self._running, self._steps = False, None

    @contextlib.contextmanager
    def _forgiven(self) -> Iterator[None]:
        """A trace that cannot be written is no reason to end a run."""
        try:
            yield
        except (OSError, RuntimeError) as error:  # the profiler's own are RuntimeErrors
            logging.warning("no trace in %s: %s", self._folder, one_line(error))
            self._steps = None
