"""Arrays beyond the memory: in a file without a name, and a full disk named beforehand."""

from pathlib import Path

import numpy as np
import pytest

from logvggt_jax.errors import DiskError
from logvggt_jax.evaluation import scratch
from logvggt_jax.evaluation.scratch import scratch_array


def test_large_arrays_lie_in_a_file_without_a_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(scratch, "_IN_MEMORY", 1000)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert not isinstance(scratch_array((10, 10), np.float32), np.memmap)
    large = scratch_array((300, 2), np.float32)
    assert isinstance(large, np.memmap) and not large.any()
    assert list(tmp_path.iterdir()) == [], "nothing is left behind, however the process ends"
    large[7] = 3.0
    assert large.sum() == 6.0


def test_a_full_disk_is_named_before_it_is_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(DiskError, match=rf"{tmp_path}: a clip needs .* set TMPDIR"):
        scratch_array((2**50,), np.uint8)
