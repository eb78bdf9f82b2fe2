"""MVS-Synth: the left-handed world, half floats and sky, the one size that is read."""

import sys
from pathlib import Path

import numpy as np
import pytest
from layouts.layout import VIEWS
from layouts.mvs_synth import LAYOUT, write_exr

from logvggt_jax.data.formats.exr import read_exr
from logvggt_jax.data.readers.mvs_synth import MVSSynth


@pytest.fixture
def root(tmp_path: Path) -> Path:
    LAYOUT.write(tmp_path, VIEWS)
    return tmp_path


def test_sky_and_other_invalid_depth_become_zero_and_half_floats_are_read(root: Path):
    depth = np.full(VIEWS[0].depth.shape, 7.5, np.float16)
    depth[0, :4] = [np.inf, np.nan, -np.inf, -1]
    depth[1] = 0
    write_exr(root / "GTAV_720/0000/depths/0000.exr", depth, channel="V")
    frames = MVSSynth(root).read("0000", [0])
    assert not frames.depth[0, 0, :4].any() and not frames.depth[0, 1].any() and (frames.depth[0, 2:] == 7.5).all()


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(ImportError, match=r"logvggt-jax\[data\]"):
        read_exr(tmp_path / "0000.exr")
