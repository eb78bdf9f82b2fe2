"""The full-size network is VGGT-1B."""

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "parity_1b.py"


@pytest.mark.slow
def test_every_output_of_the_1b_model(golden_dir):
    spec = importlib.util.spec_from_file_location("parity_1b", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    comparisons = script.compare(golden_dir)
    expected = {"dino_patch_tokens", "agg_23", "pose_enc_iter0", "pose_enc_iter3", "depth", "depth_conf"}
    assert expected <= {comparison.name for comparison in comparisons}
    assert [comparison for comparison in comparisons if not comparison.ok] == []
