"""State dicts that read one tensor at a time."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np


class LazyTensors(Mapping[str, np.ndarray]):
    """A mapping of tensor names, in file order, whose arrays `read` gives each time they are asked for; none is kept.

    It keeps the conversion of a 5 GB checkpoint at one copy of the parameters in memory.
    """

    def __init__(self, names: Sequence[str], read: Callable[[str], np.ndarray]) -> None:
        self._names = dict.fromkeys(names)
        self._read = read

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
