"""What is said of a trace that was asked for and is not there."""

from pathlib import Path

import pytest

from logvggt_jax.training.reporting.profile import ProfiledSteps, Profiler


def test_steps_that_a_run_does_not_reach_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Profiler(ProfiledSteps.parse("20:25"), tmp_path / "profile") as profiler:
        for step in (18, 19):
            profiler.before(step)
    assert "none of the steps 20 to 25 was made" in caplog.text and not list(tmp_path.iterdir())
    caplog.clear()
    with Profiler(None, tmp_path / "profile") as profiler:
        profiler.before(20)
    assert not caplog.text
