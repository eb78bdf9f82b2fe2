"""Where the viewer is served, and how commands that take a while are watched."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from logvggt_jax.errors import InputError

if TYPE_CHECKING:
    from logvggt_jax.reconstruction.result import Reconstruction
    from logvggt_jax.reconstruction.viewer import RunWindow


_HOST, _PORT = "127.0.0.1", 8080


def address_options(parser: argparse._ActionsContainer) -> None:
    """Adds where the viewer's page is served."""
    parser.add_argument("--port", type=int, default=_PORT, help="of the web page; the next free one if in use")
    parser.add_argument("--host", default=_HOST, help="serve at this address, to the network that it belongs to")


def check_unserved(options: argparse.Namespace, mend: str) -> None:
    """InputError, with what to do, where an address is given for a page that is not served."""
    if (options.host, options.port) != (_HOST, _PORT):
        raise InputError(f"--host and --port are where the viewer's page is served: {mend}")


def watch_options(parser: argparse.ArgumentParser) -> None:
    """Adds the choice to look on in the browser while the command runs."""
    viewer = parser.add_argument_group("viewer")
    viewer.add_argument(
        "--view",
        action="store_true",
        help="show points and cameras in the browser as they become final, about once a second, and at the end the "
        "result as `logvggt view` does; then the viewer stays open until Ctrl-C",
    )
    address_options(viewer)


def address(server: Any) -> str:
    """Of a viewer's page."""
    return f"http://{server.get_host()}:{server.get_port()}"


def say_access(server: Any, host: str) -> None:
    """Says on standard error who can reach the page, where that is not this machine alone."""
    from logvggt_jax.reconstruction.viewer import access_note

    if note := access_note(host, server.get_port()):
        print(f"logvggt: {note}", file=sys.stderr)


def check_watch(options: argparse.Namespace) -> None:
    """InputError where the command is to be watched and its page cannot be served, or has an address and is not."""
    if not options.view:
        check_unserved(options, "give --view, too")
    else:
        from logvggt_jax.reconstruction.viewer import check_viewer

        check_viewer(options.host, options.port)


@contextmanager
def watched(options: argparse.Namespace) -> Iterator[RunWindow | None]:
    """The page of the command's run while the block lasts; None where it is not asked for."""
    if not options.view:
        yield None
        return
    from logvggt_jax.reconstruction.viewer import stop_server, watch_run

    window = watch_run(host=options.host, port=options.port)
    try:
        print(f"logvggt: open {address(window.server)} in a browser to look on", file=sys.stderr, flush=True)
        say_access(window.server, options.host)
        yield window
    finally:
        stop_server(window.server)


def stay_open(window: RunWindow | None, result: Reconstruction | None) -> None:
    """Shows what has become of the run, if it is watched, until Ctrl-C."""
    if window is None:
        return
    from logvggt_jax.reconstruction.viewer import serve_until_interrupt

    window.show_result(result)
    sys.stdout.flush()
    print("logvggt: viewer stays open; Ctrl-C ends it", file=sys.stderr, flush=True)
    serve_until_interrupt()
