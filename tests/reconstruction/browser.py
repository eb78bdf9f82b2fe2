"""A browser without a window, for tests of pages; WebGL is drawn by the processor."""

from __future__ import annotations

import contextlib
import io
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

SIZE = (500, 800)


def browser_command(profile: Path) -> list[str]:
    """The start of a command line; skips the test where no Chromium is installed."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        pytest.skip("no Chromium is installed")
    options = ("headless", "no-sandbox", "use-angle=swiftshader", "enable-unsafe-swiftshader", "hide-scrollbars")
    size = f"--window-size={SIZE[1]},{SIZE[0]}"
    return [program, *(f"--{option}" for option in options), size, f"--user-data-dir={profile}"]


def photograph(page: Path, profile: Path, *options: str) -> np.ndarray:
    """What a page in a file looks like, [H, W, 3] uint8."""
    picture = profile.with_suffix(".png")
    command = [*browser_command(profile), *options, "--virtual-time-budget=2000", f"--screenshot={picture}"]
    subprocess.run([*command, page.as_uri()], check=True, capture_output=True, timeout=120)
    return np.asarray(Image.open(io.BytesIO(picture.read_bytes())).convert("RGB"))


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
