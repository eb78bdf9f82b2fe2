"""Formats that a reconstruction can be written in: one file each, and its line in the registry.

An exporter is called with the reconstruction, the path to write, and as keywords the `PointFilter` that says which
pixels become points, and whether to show progress; it uses what its format holds. It reads the reconstruction through
its handle and nothing else.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from logvggt_jax.reconstruction.exporters.ply import export_ply
from logvggt_jax.reconstruction.exporters.tum import export_tum
from logvggt_jax.reconstruction.point_cloud import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction


class Exporter(Protocol):
    """Writes a reconstruction in one format."""

    def __call__(
        self, result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
    ) -> None:
        """Writes `path`, whole or not at all."""


EXPORTERS: dict[str, Exporter] = {"ply": export_ply, "tum": export_tum}
"""Exporters by the format's name."""
