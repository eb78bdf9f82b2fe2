"""Clips: evenly spaced in either direction, or walks over neighbours; inside the sequence, reproducible."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from logvggt_jax.data.feeding.sampling import ClipSampler, CovisibilityWalk, example_rng, sampler_for
from logvggt_jax.data.rooms.rooms import Rooms


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
        assert (steps == steps[0]).all() and low <= abs(steps[0]) <= low + extra
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


def chain(count: int) -> dict[int, list[tuple[int, float]]]:
    """Frames that see the one before and the one after, told in one direction only."""
    return {i: [(i + 1, 1.0)] for i in range(count - 1)}


@settings(deadline=None, max_examples=60)
@given(
    edges=st.lists(
        st.tuples(st.integers(0, 15), st.integers(0, 15), st.floats(0.01, 5.0, allow_nan=False)), max_size=40
    ),
    length=st.integers(2, 8),
    seed=st.integers(0, 2**30),
)
def test_walks_visit_no_frame_twice_and_stay_connected(edges, length, seed):
    graph: dict[int, list[tuple[int, float]]] = {}
    for frame, other, score in edges:
        graph.setdefault(frame, []).append((other, score))
    linked = {frozenset((frame, other)) for frame, other, _ in edges if frame != other}
    components: list[set[int]] = []
    for pair in linked:
        touching = [part for part in components if part & pair]
        components = [part for part in components if not part & pair] + [set(pair).union(*touching)]
    walk = CovisibilityWalk(length)
    if max(map(len, components), default=1) < length:
        with pytest.raises(ValueError, match="connected by covisibility"):
            walk.indices(graph, example_rng(seed, 0))
        return
    frames = walk.indices(graph, example_rng(seed, 0)).tolist()
    assert len(set(frames)) == len(frames) == length
    for position in range(1, length):
        assert any(frozenset((frames[position], earlier)) in linked for earlier in frames[:position])
    assert frames == walk.indices(graph, example_rng(seed, 0)).tolist()


def test_walks_prefer_frames_that_share_more():
    graph = {0: [(1, 9.0), (2, 1.0)]}
    walks = [CovisibilityWalk(2).indices(graph, example_rng(0, i)).tolist() for i in range(3000)]
    seconds = [walk[1] for walk in walks if walk[0] == 0]
    assert seconds.count(1) / len(seconds) == pytest.approx(0.9, abs=0.03)


def test_a_walk_goes_back_from_dead_ends():
    # From the middle of a chain one end is reached before the other; all frames are needed.
    for index in range(50):
        assert sorted(CovisibilityWalk(7).indices(chain(7), example_rng(1, index)).tolist()) == list(range(7))


def test_data_sets_with_covisibility_are_walked_and_others_sampled_in_time_order():
    class Photographs:
        def num_frames(self, sequence: str) -> int:
            return 6

        def covisibility(self, sequence: str) -> dict[int, list[tuple[int, float]]]:
            return {"joined": chain(6), "parted": {0: [(1, 1.0)], 2: [(3, 1.0)], 4: [(5, 1.0)]}}[sequence]

    photographs = Photographs()
    walk = sampler_for(photographs, length=4, stride=(1, 2), reverse=0.5)
    assert walk == CovisibilityWalk(4)
    assert walk.fits(photographs, "joined") and not walk.fits(photographs, "parted")
    assert len(set(walk.draw(photographs, "joined", example_rng(0, 0)).tolist())) == 4
    rooms = Rooms("val", num_rooms=1, num_frames=7)
    assert sampler_for(rooms, length=4, stride=(1, 2), reverse=0.5) == ClipSampler(4, (1, 2), 0.5)
