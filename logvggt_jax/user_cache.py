"""The user's cache folder: what can be made again and is kept to save time."""

from __future__ import annotations

import os
from pathlib import Path


def user_cache_folder(kind: str) -> Path:
    """`logvggt/<kind>` in the user's cache folder (`XDG_CACHE_HOME`, else `~/.cache`); not created here."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "logvggt" / kind
