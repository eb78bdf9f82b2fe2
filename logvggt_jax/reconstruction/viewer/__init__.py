"""Looking at a reconstruction: in the browser through a server (extra `viewer`), or as one page without one."""

from logvggt_jax.reconstruction.viewer.page import save_page
from logvggt_jax.reconstruction.viewer.serving import access_note, open_viewer, serve_forever

__all__ = ["access_note", "open_viewer", "save_page", "serve_forever"]
