"""The documentation becomes a site without a broken link, and asks no other host for anything."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from shell_lines import ROOT


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason="needs the extra `docs`")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_page_is_reached_from_the_first(site: Path) -> None:
    pages = {path.relative_to(site).as_posix() for path in site.rglob("*.html")} - {"404.html"}
    linked = set(re.findall(r'href="([\w/-]+\.html)', (site / "index.html").read_text()))
    assert {"index.html", "quick-start.html", "methods.html", "clusters.html"} <= pages
    assert pages - {"index.html"} <= linked


def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        loaded = re.findall(r'<(?:script|img|iframe)[^>]+src="([^"]+)"|<link[^>]+href="([^"]+)"', page.read_text())
        assert [address for pair in loaded for address in pair if re.match(r"(https?:)?//", address)] == []


def test_the_picture_of_the_conventions_is_drawn(site: Path) -> None:
    assert 'src="images/conventions.svg"' in (site / "conventions.html").read_text()
    assert (site / "images" / "conventions.svg").is_file()
