"""Arrays of a snapshot, whose names say of which part of a stream they are: `part/name`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


def of_part(part: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A part's arrays by the names that they have in the snapshot."""
    return {f"{part}/{name}": array for name, array in arrays.items()}


def part_of(arrays: Mapping[str, np.ndarray], part: str) -> dict[str, np.ndarray]:
    """The arrays of a part of a snapshot, by the names that the part knows them by."""
    prefix = f"{part}/"
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
