"""The libraries that some formats are written with, each in an extra of this package."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from logvggt_jax.errors import MissingPackage, install_line, one_line

_EXTRAS = {"pycolmap": "colmap", "trimesh": "formats", "rosbags": "formats", "OpenEXR": "formats"}


def library(name: str, module: str | None = None) -> Any:
    """A module of a library; MissingPackage with the line that installs it where it is not there, or does not load.

    Args:
      name: of the library, as it is imported.
      module: inside it; None for itself.
    """
    check_library(name)
    try:
        return importlib.import_module(module or name)
    except ImportError as error:
        raise MissingPackage(
            f"this needs {name}, which is installed and does not load ({one_line(error)}): install it again, "
            f"{install_line(_EXTRAS[name])}"
        ) from error


def check_library(name: str) -> None:
    """MissingPackage unless the library is installed."""
    if importlib.util.find_spec(name) is None:
        raise MissingPackage(f"this needs {name}, which is not installed: {install_line(_EXTRAS[name])}")
