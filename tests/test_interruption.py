"""Ctrl-C while programs import what they need, which takes them seconds: one line, and the code of an interruption."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Sends the signal when a module of this name is looked for, and then does as an extension that takes what interrupts it
# for an error of its own.
_PRESS = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
class Press:
    def find_spec(self, name, *_):
        if name == "{module}":
            sys.meta_path.remove(self)
            try:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(5)
            except BaseException:
                raise ImportError("Encountered an error while initializing the extension.")
sys.meta_path.insert(0, Press())
"""


@pytest.mark.parametrize(
    ("name", "command", "module"),
    [
        ("train.py", ["train.py", "--config=configs/tiny.py", "--workdir=none"], "jax"),
        ("eval.py", ["eval.py", "--config=configs/eval/rooms.py", "--checkpoint=none", "--output=none"], "absl"),
        ("logvggt", ["-m", "logvggt_jax", "data", "list"], "logvggt_jax.cli.program"),
        ("logvggt", ["-m", "logvggt_jax", "data", "list"], "numpy"),
    ],
)
def test_ctrl_c_while_modules_are_imported_is_one_line(
    name: str, command: list[str], module: str, tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(_PRESS.format(module=module))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), str(ROOT)))}
    finished = subprocess.run(
        [sys.executable, *command], cwd=ROOT, capture_output=True, text=True, env=environment, check=False, timeout=60
    )
    assert (finished.returncode, finished.stderr) == (130, f"{name}: interrupted\n")


def test_ctrl_c_while_libraries_clean_up_is_no_traceback() -> None:
    program = """
import atexit, os, signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)
@atexit.register
def clean_up():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(5)
from logvggt_jax.interruption import one_line_at_ctrl_c
with one_line_at_ctrl_c("program"):
    print("done", flush=True)
"""
    finished = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False, timeout=60
    )
    assert (finished.returncode, finished.stdout, finished.stderr) == (-signal.SIGINT, "done\n", "")
