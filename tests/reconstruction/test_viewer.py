"""The viewer shows what was reconstructed, to this machine only."""

from __future__ import annotations

import socket
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from result_folder import write_result

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.viewer import access_note, open_viewer


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_page_is_served_to_this_machine_only(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    write_result(tmp_path)
    server = open_viewer(tmp_path, port=18080)
    try:
        assert server.get_host() == "127.0.0.1"
        with urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}/", timeout=10) as page:
            assert page.status == 200
    finally:
        server.stop()


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"port": 70000}, "port must be 1 to 65535, got 70000"),
        ({"port": 0}, "port must be 1 to 65535, got 0"),
        ({"host": "no such host"}, "cannot be served at 'no such host', port 8080"),
        ({"host": "192.0.2.1"}, r"cannot be served at '192\.0\.2\.1', port 8080"),
        ({"host": 70 * "x" + ".org"}, "cannot be served at"),
    ],
)
def test_where_nothing_can_be_served_is_one_line_and_no_wait(
    tmp_path: Path, options: dict[str, Any], complaint: str
) -> None:
    write_result(tmp_path)
    with pytest.raises(InputError, match=complaint):
        open_viewer(tmp_path, **options)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_port_in_use_is_passed_over(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    write_result(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        server = open_viewer(tmp_path, port=port)
        try:
            assert server.get_port() > port
        finally:
            server.stop()


def test_whoever_opens_the_page_to_others_reads_of_tunnels() -> None:
    assert access_note("127.0.0.1", 8080) == access_note("localhost", 8080) == ""
    assert "ssh -N -L 8081:localhost:8081" in access_note("0.0.0.0", 8081)


def test_a_folder_without_reconstruction_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"cameras\.json does not exist"):
        open_viewer(tmp_path)
