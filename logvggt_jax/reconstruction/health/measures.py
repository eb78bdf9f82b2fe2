"""The numbers of a health report: what is measured of every frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

# Frames between the two whose points are searched for conflicts: what moves has then moved by more than a cell.
CONFLICTS_APART = 4


def _measure(title: str, unit: str) -> Any:
    return dataclasses.field(metadata={"title": title, "unit": unit})


@dataclasses.dataclass(frozen=True, eq=False)
class Measures:
    """Float64 arrays [N], one number a frame; NaN where it is not known.

    Attributes:
      brightness: mean grey level, 1 is white.
      dark: share of pixels that are nearly black.
      bright: share of pixels that are nearly white.
      sharpness: variance of the Laplacian over the squared mean grey level: fine detail.
      detail: median over cells, twelve a row, of the squared Laplacian over the squared mean grey level: fine detail
        wherever one looks, which an edge that comes into view does not change.
      texture: gradient energy of the picture at a quarter of its size over the squared mean grey level: coarse detail.
      picture_change: one minus the correlation with the frame before, of small grey pictures.
      confidence: the median over the pixels.
      field_of_view: horizontal, degrees, as the model predicts it.
      step: way of the camera since the frame before, as a fraction of that frame's median depth.
      turn: of the camera since the frame before, degrees.
      overlap: share of a coarse grid of points that this frame and the one before both see.
      disagreement: median relative difference between this frame's depth and that of the one before, where both see.
      conflicts: share of points that should be seen from the camera four frames away and are not, see `neighbours`.
      shared_picture: share of the picture that the frame before shows as well, by the shift at which both are most
        alike; NaN where they are not alike.
      elsewhere: share of the picture that was not near its place in the frame four before, see `compare_pictures`.
      likeness: correlation of the pictures of this frame and the one before, at the points that both see.
      overlap_change: how far apart the two copies of the frame are that two windows predict, see `FrameResult`.
      correction: how far GCCR moved the frame's camera token, see `Signals`.
      chunk_scale: see `Signals`.
      chunk_residual: see `Signals`.
    """

    brightness: np.ndarray = _measure("Brightness", "of white")
    dark: np.ndarray = _measure("Dark pixels", "share")
    bright: np.ndarray = _measure("Overexposed pixels", "share")
    sharpness: np.ndarray = _measure("Sharpness", "variance of the Laplacian")
    detail: np.ndarray = _measure("Detail everywhere", "squared Laplacian")
    texture: np.ndarray = _measure("Texture", "gradient energy")
    picture_change: np.ndarray = _measure("Change of the picture", "1 - correlation")
    confidence: np.ndarray = _measure("Confidence", "median")
    field_of_view: np.ndarray = _measure("Field of view", "degrees")
    step: np.ndarray = _measure("Step of the camera", "of the median depth")
    turn: np.ndarray = _measure("Turn of the camera", "degrees")
    overlap: np.ndarray = _measure("Overlap with the frame before", "share")
    disagreement: np.ndarray = _measure("Depth against the frame before", "relative difference")
    conflicts: np.ndarray = _measure("Points that should be seen", "share")
    shared_picture: np.ndarray = _measure("Picture shared with the frame before", "share")
    elsewhere: np.ndarray = _measure("Picture that was not there before", "share")
    likeness: np.ndarray = _measure("Pictures of what both see", "correlation")
    overlap_change: np.ndarray = _measure("Two windows on the same frame", "relative difference")
    correction: np.ndarray = _measure("Correction by GCCR", "of the token")
    chunk_scale: np.ndarray = _measure("Scale of the chunks", "of the first")
    chunk_residual: np.ndarray = _measure("Chunks on the frames they share", "of the median depth")

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray], count: int) -> Measures:
        """Arrays by name, rounded to six digits as they are stored; what is missing is NaN."""
        unknown = np.full(count, np.nan)
        return cls(**{name: _rounded(arrays.get(name, unknown)) for name in NAMES})

    def arrays(self) -> dict[str, np.ndarray]:
        """All by name."""
        return {name: getattr(self, name) for name in NAMES}

    @property
    def num_frames(self) -> int:
        """N."""
        return len(self.brightness)


NAMES = tuple(field.name for field in dataclasses.fields(Measures))
TITLES = {field.name: (field.metadata["title"], field.metadata["unit"]) for field in dataclasses.fields(Measures)}


def _rounded(values: np.ndarray) -> np.ndarray:
    return np.array([float(f"{value:.6g}") for value in np.asarray(values, np.float64)])
