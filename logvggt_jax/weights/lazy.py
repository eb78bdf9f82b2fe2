"""State dicts that read one tensor at a time."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from logvggt_jax.errors import InputError


class Header(NamedTuple):
    """What a file says of a tensor before it is read; the type by numpy's name."""

    shape: tuple[int, ...]
    dtype: str


class LazyTensors(Mapping[str, np.ndarray]):
    """A mapping of tensor names, in file order, whose arrays `read` gives each time they are asked for; none is kept.

    It keeps the conversion of a 5 GB checkpoint at one copy of the parameters in memory. `origin` says, for errors,
    which entry of the file it is, where it is not the whole file. `header` gives what is known of a tensor without
    reading it, None of each where nothing is.
    """

    def __init__(
        self,
        names: Sequence[str],
        read: Callable[[str], np.ndarray],
        origin: str | None = None,
        header: Callable[[str], Header | None] = lambda _: None,
    ) -> None:
        self._names = dict.fromkeys(names)
        self._read = read
        self.origin = origin
        self.header = header

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise KeyError(name)
        return self._read(name)

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def refused_type(path: Path, name: str, dtype: str) -> InputError:
    """The error of a tensor whose type is not read."""
    return InputError(
        f"{path}: tensor {name} is {dtype}, which is not read; expected float32, float16, bfloat16 or float64: give a "
        "checkpoint in one of these"
    )
