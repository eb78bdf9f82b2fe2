"""The viewer shows what was reconstructed, to this machine only."""

from __future__ import annotations

import urllib.request
from pathlib import Path

import pytest
from result_folder import write_result

from logvggt_jax.reconstruction.viewer import open_viewer


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


def test_a_folder_without_reconstruction_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"cameras\.json does not exist"):
        open_viewer(tmp_path)
