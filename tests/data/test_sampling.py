"""Clips: evenly spaced, inside the sequence, in either direction, reproducible."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from logvggt_jax.data.sampling import ClipSampler, example_rng


@settings(deadline=None)
@given(
    length=st.integers(1, 12),
    low=st.integers(1, 4),
    extra=st.integers(0, 4),
    surplus=st.integers(0, 60),
    reverse=st.sampled_from([0.0, 0.5, 1.0]),
    index=st.integers(0, 2**40),
)
def test_clips_are_evenly_spaced_and_inside(length, low, extra, surplus, reverse, index):
    sampler = ClipSampler(length=length, stride=(low, low + extra), reverse=reverse)
    num_frames = sampler.shortest + surplus
    clip = sampler.indices(num_frames, example_rng(3, index))
    assert clip.shape == (length,) and clip.min() >= 0 and clip.max() < num_frames
    steps = np.diff(clip)
    if length > 1:
        assert (steps == steps[0]).all()
        assert low <= abs(steps[0]) <= low + extra
        assert reverse == 0.5 or (steps[0] < 0) == (reverse == 1.0)
    assert np.array_equal(clip, sampler.indices(num_frames, example_rng(3, index)))


def test_all_strides_starts_and_directions_occur():
    sampler = ClipSampler(length=3, stride=(1, 3))
    clips = {tuple(sampler.indices(8, example_rng(0, i)).tolist()) for i in range(2000)}
    # 6 starts for stride 1, 4 for stride 2, 2 for stride 3, each in two directions.
    assert len(clips) == 24


def test_a_sequence_that_is_too_short_is_refused():
    with pytest.raises(ValueError, match="needs 7 frames, the sequence has 6"):
        ClipSampler(length=4, stride=(2, 3)).indices(6, example_rng(0, 0))


@pytest.mark.parametrize(
    "options",
    [{"length": 0}, {"length": 2, "stride": (3, 2)}, {"length": 2, "stride": (0, 2)}, {"length": 2, "reverse": 2}],
)
def test_bad_options_are_refused(options: dict):
    with pytest.raises(ValueError, match="clip"):
        ClipSampler(**options)
