"""A browser without a window, for tests of pages; WebGL is drawn by the processor."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

SIZE = (500, 800)


def browser_command(profile: Path) -> list[str]:
    """The start of a command line; skips the test where no Chromium is installed."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        pytest.skip("no Chromium is installed")
    options = ("headless", "no-sandbox", "use-angle=swiftshader", "enable-unsafe-swiftshader", "hide-scrollbars")
    size = f"--window-size={SIZE[1]},{SIZE[0]}"
    return [program, *(f"--{option}" for option in options), size, f"--user-data-dir={profile}"]


@contextlib.contextmanager
def visitor(address: str, profile: Path) -> Iterator[None]:
    """A browser that looks at an address while the block runs."""
    command = [*browser_command(profile), "--remote-debugging-port=0", address]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait(60)
