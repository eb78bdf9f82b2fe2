"""The full-size network is VGGT-1B."""

import pytest


@pytest.mark.slow
def test_every_output_of_the_1b_model(golden_dir):
    import parity_1b  # chooses the platform for the whole process

    comparisons = parity_1b.compare(golden_dir)
    expected = {"dino_patch_tokens", "agg_23", "pose_enc_iter0", "pose_enc_iter3", "depth", "depth_conf"}
    assert expected <= {comparison.name for comparison in comparisons}
    assert [comparison for comparison in comparisons if not comparison.ok] == []
