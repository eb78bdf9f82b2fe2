"""A write that fails is one line, whatever else was under way."""

import gc
import logging
import resource
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from logvggt_jax.errors import DiskError
from logvggt_jax.weights.checkpoints import load_model, save_model, write_arrays
from logvggt_jax.weights.orbax_writing import writing_with_orbax


@pytest.mark.parametrize("name", ["plain", "sweep[3]", "a*", "a?", "a\\b", "straße (1) #%20"])
def test_a_model_is_read_back_whatever_its_folder_is_called(name, tmp_path, small_config, small_variables):
    (tmp_path / "ab").mkdir()
    save_model(tmp_path / name / "model", small_config, small_variables["params"])
    found = load_model(tmp_path / name / "model")[1]["params"]
    jax.tree.map(np.testing.assert_array_equal, found, small_variables["params"])


def test_a_save_says_nothing_and_a_failed_one_its_line_alone(tmp_path, small_config, small_variables, caplog):
    save_model(tmp_path / "model", small_config, small_variables["params"])
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    library = logging.LogRecord("absl", logging.ERROR, "/site/orbax/checkpoint/future.py", 1, "a trace", None, None)
    told = (
        "Task exception was never retrieved\nfuture: <Task finished coro=<write() at /site/orbax/checkpoint/write.py:1>"
    )
    future = (
        "Future exception was never retrieved\nfuture: <Future finished exception=ValueError('[os_error_code='27']')>"
    )
    left_behind = [
        logging.LogRecord("asyncio", logging.ERROR, "/lib/asyncio/base_events.py", 1, text, None, None)
        for text in (told, future)
    ]
    with pytest.raises(DiskError, match="No space left"), writing_with_orbax(tmp_path):
        logging.getLogger("absl").handle(library)
        for record in left_behind:
            logging.getLogger("asyncio").handle(record)
        logging.getLogger("absl").error("ours")
        raise ValueError("RESOURCE_EXHAUSTED: Error writing: No space left on device [os_error_code='28']")
    assert [record.getMessage() for record in caplog.records] == ["ours"]


def test_writes_that_end_after_one_has_failed_say_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    heard: list[sys.UnraisableHookArgs] = []
    monkeypatch.setattr(sys, "unraisablehook", heard.append)
    arrays = {str(number): np.full(100_000, number, np.float32) for number in range(100)}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # No file may be larger than this, as on a disk that is full.
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        with pytest.raises(DiskError, match=r"arrays: File too large$"), writing_with_orbax(tmp_path / "arrays"):
            write_arrays(tmp_path / "arrays", arrays)
        time.sleep(0.3)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    gc.collect()
    assert not heard and not caplog.records
    write_arrays(tmp_path / "later", arrays)


def test_what_else_goes_wrong_in_the_background_is_still_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    heard: list[sys.UnraisableHookArgs] = []
    monkeypatch.setattr(sys, "unraisablehook", heard.append)
    with writing_with_orbax(tmp_path):
        pass

    class Odd:
        def __del__(self) -> None:
            raise RuntimeError("a bug")

    Odd()
    gc.collect()
    assert [str(each.exc_value) for each in heard] == ["a bug"]
