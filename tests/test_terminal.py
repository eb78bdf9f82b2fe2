"""A stream that cannot be written loses no result and ends no work."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import pytest

from logvggt_jax.terminal import ForgivingStream

COMMAND = f"{sys.executable} -m logvggt_jax data list"


class Broken(io.StringIO):
    """A terminal that is gone."""

    def __init__(self, error: Exception) -> None:
        super().__init__()
        self.error, self.tries = error, 0

    def write(self, text: str) -> int:
        self.tries += 1
        raise self.error

    def isatty(self) -> bool:
        return True


def test_a_warning_comes_once_although_libraries_log_while_they_are_imported() -> None:
    program = (
        "from absl import app, logging\n"
        "logging.warning('imported')\n"
        "from logvggt_jax.terminal import one_log_handler\n"
        "one_log_handler()\n"
        "app.run(lambda _: logging.warning('a warning'))\n"
    )
    finished = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert finished.stderr.count("a warning") == 1


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), BrokenPipeError(), ValueError("closed")])
def test_the_first_failure_is_remembered_and_nothing_more_is_tried(error: Exception) -> None:
    broken = Broken(error)
    stream = ForgivingStream(broken)
    assert stream.isatty()
    assert stream.write("a") == 1
    stream.write("b")
    stream.flush()
    assert stream.failure is error and broken.tries == 1 and not stream.isatty()


def test_what_the_encoding_lacks_is_escaped() -> None:
    raw = io.BytesIO()
    stream = ForgivingStream(io.TextIOWrapper(raw, "ascii"))
    stream.write("walk über")
    stream.flush()
    assert raw.getvalue() == b"walk \\xfcber" and stream.failure is None


def run(redirection: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", f"{COMMAND} {redirection}"], cwd=folder, capture_output=True, text=True, check=False, timeout=60
    )


def test_a_reader_that_goes_away_is_no_error(tmp_path: Path) -> None:
    done = run("| head -n 1; exit ${PIPESTATUS[0]}", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_standard_output_is_said_once(tmp_path: Path) -> None:
    done = run("> /dev/full", tmp_path)
    assert done.returncode == 1
    assert done.stderr == "logvggt: error: standard output cannot be written: [Errno 28] No space left on device\n"


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_descriptors_are_filled(tmp_path: Path, closed: str) -> None:
    done = run(closed, tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
