"""Looking at a reconstruction: in the browser through a server (extra `viewer`), or as one page without one."""

from logvggt_jax.reconstruction.viewer.page import save_page
from logvggt_jax.reconstruction.viewer.run_window import RunWindow
from logvggt_jax.reconstruction.viewer.serving import (
    access_note,
    check_viewer,
    open_viewer,
    serve_until_interrupt,
    stop_server,
    watch_run,
)

__all__ = [
    "RunWindow",
    "access_note",
    "check_viewer",
    "open_viewer",
    "save_page",
    "serve_until_interrupt",
    "stop_server",
    "watch_run",
]
