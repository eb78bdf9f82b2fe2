"""Numbers a frame that a stream keeps on the host, in memory that doubles."""

from __future__ import annotations

import numpy as np


class Rows:
    """Rows of equal shape, appended at the end: a stream of any length copies each a few times, not once a window."""

    def __init__(self, rows: np.ndarray) -> None:
        self._buffer, self._count = rows.copy(), len(rows)

    def __len__(self) -> int:
        return self._count

    @property
    def array(self) -> np.ndarray:
        """All rows; a view to read, which later rows do not change."""
        rows = self._buffer[: self._count]
        rows.flags.writeable = False
        return rows

    def append(self, rows: np.ndarray) -> None:
        """Adds rows [n, ...]."""
        needed = self._count + len(rows)
        if needed > len(self._buffer):
            grown = np.empty((2 * needed, *self._buffer.shape[1:]), self._buffer.dtype)
            grown[: self._count] = self.array
            self._buffer = grown
        self._buffer[self._count : needed] = rows
        self._count = needed
