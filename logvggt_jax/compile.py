"""Compiled programs kept between runs, so that only the first run of a shape waits for the compiler."""

import os
from pathlib import Path

import jax

from logvggt_jax.files import user_cache_folder


def default_cache_folder() -> Path:
    """`logvggt/xla` in the user's cache folder (`XDG_CACHE_HOME`, else `~/.cache`)."""
    return user_cache_folder("xla")


def enable_compilation_cache(folder: str | None = None) -> Path | None:
    """Turns JAX's persistent compilation cache on in `folder`, which it returns; `none` leaves it off and gives None.

    The default is JAX's own `JAX_COMPILATION_CACHE_DIR` if set, else `default_cache_folder`.
    """
    if folder == "none":
        jax.config.update("jax_enable_compilation_cache", False)
        return None
    chosen = Path(folder or os.environ.get("JAX_COMPILATION_CACHE_DIR") or default_cache_folder()).expanduser()
    jax.config.update("jax_compilation_cache_dir", str(chosen))
    return chosen
