"""Rooms in another form, which answer as the rooms themselves do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.frames import Frames

Rooms = TypeVar("Rooms", bound=Dataset)


class SameRooms(Generic[Rooms]):
    """A `Dataset` that stands for `rooms`; subclasses say where their frames come from.

    Attributes:
      rooms: the rooms.
      sequences: their names.
    """

    def __init__(self, rooms: Rooms) -> None:
        self.rooms = rooms
        self.sequences = rooms.sequences

    @property
    def identity(self) -> Mapping[str, Any]:
        """That of the rooms."""
        return self.rooms.identity

    def num_frames(self, sequence: str) -> int:
        """Frames of `sequence`."""
        return self.rooms.num_frames(sequence)

    def image_size(self, sequence: str) -> tuple[int, int]:
        """(H, W): the same for all rooms."""
        return self.rooms.image_size(sequence)

    def frame_names(self, sequence: str) -> Sequence[str]:
        """Names as the rooms give them."""
        return self.rooms.frame_names(sequence)

    def sfm_extrinsics(self, sequence: str, indices: Sequence[int]) -> np.ndarray | None:
        """None: rooms have exact poses only."""
        return self.rooms.sfm_extrinsics(sequence, indices)

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        """Frames `indices`, as the rooms give them."""
        return self.rooms.read(sequence, indices)
