"""Batches: shapes, coverage, shards, exact resume, and bad data named."""

from __future__ import annotations

import json
from itertools import islice

import numpy as np
import pytest

from logvggt_jax.data.pipeline import training_batches
from logvggt_jax.types import Frames


class Numbered:
    """Sequences whose pictures say where they come from: red = sequence, green = frame."""

    def __init__(self, count: int, num_frames: int = 9, first: int = 0) -> None:
        self.sequences = [f"s{i}" for i in range(first, first + count)]
        self._num_frames = num_frames

    def num_frames(self, sequence: str) -> int:
        return self._num_frames

    def frame_names(self, sequence: str) -> list[str]:
        return [str(i) for i in range(self._num_frames)]

    def read(self, sequence: str, indices) -> Frames:
        images = np.zeros((len(indices), 14, 28, 3), np.uint8)
        images[..., 0] = int(sequence[1:])
        images[..., 1] = np.reshape(indices, (-1, 1, 1))
        intrinsics = np.array([[20, 0, 14], [0, 20, 7], [0, 0, 1]], np.float32)
        return Frames(
            images=images,
            depth=np.ones(images.shape[:3], np.float32),
            intrinsics=np.tile(intrinsics, (len(indices), 1, 1)),
            extrinsics=np.tile(np.eye(4, dtype=np.float32), (len(indices), 1, 1)),
            metric=True,
        )


class Damaged(Numbered):
    """Like `Numbered`, with one field spoilt in every frame 0."""

    def __init__(self, field: str, value: float) -> None:
        super().__init__(2, num_frames=2)
        self.field, self.value = field, value

    def read(self, sequence: str, indices) -> Frames:
        frames = super().read(sequence, indices)
        array = getattr(frames, self.field).copy()
        array[list(indices).index(0), 0, 0] = self.value
        return frames._replace(**{self.field: array})


def batches(datasets=None, **changes):
    options = {"clip_length": 3, "batch_size": 4, "size": (14, 28), "seed": 5, "stride": (1, 3), **changes}
    return training_batches(datasets or {"numbered": Numbered(8)}, **options)


def clips(iterator, count: int) -> list[tuple]:
    """(sequence, frames …) of every clip of the next `count` batches."""
    return [
        (int(images[0, 0, 0, 0]), *images[:, 0, 0, 1].tolist())
        for batch in islice(iterator, count)
        for images in batch["images"]
    ]


def test_a_batch_holds_what_the_model_trains_on():
    with batches() as iterator:
        batch = next(iterator)
    shapes = {name: (array.shape, array.dtype.name) for name, array in batch.items()}
    assert shapes == {
        "images": ((4, 3, 14, 28, 3), "uint8"),
        "depth": ((4, 3, 14, 28), "float32"),
        "intrinsics": ((4, 3, 3, 3), "float32"),
        "extrinsics": ((4, 3, 4, 4), "float32"),
    }


def test_every_epoch_visits_every_sequence_once_with_new_clips_in_a_new_order():
    with batches() as iterator:
        epochs = [clips(iterator, 2) for _ in range(4)]
    for epoch in epochs:
        assert sorted(clip[0] for clip in epoch) == list(range(8))
    assert len({tuple(clip[0] for clip in epoch) for epoch in epochs}) > 1
    assert len({clip for epoch in epochs for clip in epoch}) > 20


def test_a_seed_gives_the_clips_that_it_always_gave():
    """Results of runs depend on it: these are the clips of the first version."""
    with batches() as iterator:
        drawn = clips(iterator, 2)
    assert drawn == [
        (7, 2, 5, 8),
        (3, 0, 2, 4),
        (5, 2, 3, 4),
        (6, 1, 4, 7),
        (0, 2, 4, 6),
        (2, 8, 6, 4),
        (1, 5, 6, 7),
        (4, 2, 4, 6),
    ]


def test_data_sets_have_strides_of_their_own():
    mixture = {"near": Numbered(4), "far": Numbered(4, first=100)}
    with batches(mixture, strides={"far": (4, 4)}, stride=(1, 2)) as iterator:
        drawn = clips(iterator, 20)
    steps = {far: {abs(b - a) for first, a, b, _ in drawn if (first >= 100) == far} for far in (False, True)}
    assert steps == {False: {1, 2}, True: {4}}
    with pytest.raises(ValueError, match="strides must be of near, far"):
        batches(mixture, strides={"other": (1, 1)})


def test_unordered_sets_are_walked():
    class Photographs(Numbered):
        def covisibility(self, sequence: str) -> dict[int, list[tuple[int, float]]]:
            # Even frames see even ones, odd ones odd ones.
            return {i: [(j, 1.0) for j in range(9) if j != i and (i - j) % 2 == 0] for i in range(9)}

    with batches({"photographs": Photographs(4)}, clip_length=4) as iterator:
        drawn = clips(iterator, 10)
    assert all(len({frame % 2 for frame in clip[1:]}) == 1 and len(set(clip[1:])) == 4 for clip in drawn)
    with pytest.raises(ValueError, match="photographs: none of 4 sequences has the 6 frames connected"):
        batches({"photographs": Photographs(4)}, clip_length=6)


def test_a_seed_decides_everything():
    runs = []
    for seed in (5, 5, 6):
        with batches(seed=seed) as iterator:
            runs.append(clips(iterator, 4))
    assert runs[0] == runs[1] != runs[2]


def test_resuming_equals_not_having_stopped():
    with batches() as iterator:
        clips(iterator, 3)
        state = json.loads(json.dumps(iterator.get_state()))
        expected = clips(iterator, 6)
        iterator.set_state(state)
        assert clips(iterator, 6) == expected
    for changes in ({"num_threads": 0}, {"batch_size": 2}, {"batch_size": 6, "num_threads": 1}):
        with batches(**changes) as resumed:
            resumed.set_state(state)
            assert clips(resumed, 24 // resumed._batch_size) == expected


def test_closing_keeps_the_place():
    with batches() as iterator, batches() as other:
        expected = clips(other, 4)
        got = clips(iterator, 2)
        iterator.close()
        assert got + clips(iterator, 2) == expected


def test_worker_processes_give_the_same_batches_and_resume_with_another_number():
    with batches() as iterator:
        expected = clips(iterator, 6)
    with batches(worker_count=2) as iterator:
        assert clips(iterator, 3) == expected[:12]
        state = iterator.get_state()
    with batches(worker_count=0) as iterator:
        iterator.set_state(state)
        assert clips(iterator, 3) == expected[12:]


def test_processes_share_the_global_batch():
    with batches() as iterator:
        together = clips(iterator, 6)
    shards = []
    for process in range(2):
        with batches(process_index=process, process_count=2) as iterator:
            assert next(iterator)["images"].shape[0] == 2
            iterator.set_state({**iterator.get_state(), "examples": 0})
            shards.append(clips(iterator, 6))
    assert [clip for pair in zip(*shards, strict=True) for clip in pair] == together
    epoch = [{clip[0] for clip in shard[:4]} for shard in shards]
    assert epoch[0].isdisjoint(epoch[1]) and len(epoch[0] | epoch[1]) == 8


def test_mixtures_keep_their_weights_and_do_not_end_with_the_smaller_set():
    mixture = {"large": Numbered(20), "small": Numbered(2, first=100)}
    with batches(mixture, weights={"large": 3.0, "small": 1.0}) as iterator:
        drawn = clips(iterator, 100)
    assert sum(clip[0] >= 100 for clip in drawn) == 100


def test_state_of_other_data_is_refused():
    with batches() as iterator:
        state = iterator.get_state()
        with pytest.raises(ValueError, match="seed=6, this run has 5"):
            iterator.set_state({**state, "seed": 6})
        with pytest.raises(ValueError, match="fields"):
            iterator.set_state({"examples": 3})


@pytest.mark.parametrize(
    ("field", "value", "complaint"),
    [
        ("depth", np.nan, "depth must be finite"),
        ("depth", -1.0, "depth must not be negative"),
        ("intrinsics", 0.0, "focal"),
        ("extrinsics", np.inf, "extrinsics must be finite"),
        ("extrinsics", 1.1, "rotations"),
        ("extrinsics", -1.0, "rotations"),
    ],
)
def test_bad_data_are_named(field: str, value: float, complaint: str):
    with (
        batches({"damaged": Damaged(field, value)}, clip_length=2, batch_size=1, stride=(1, 1)) as iterator,
        pytest.raises(ValueError, match=rf"damaged, s\d.*{complaint}"),
    ):
        next(iterator)


def test_sequences_too_short_for_a_clip_are_left_out_or_refused():
    class Uneven(Numbered):
        def num_frames(self, sequence: str) -> int:
            return 2 if sequence == "s0" else 9

    with batches({"uneven": Uneven(4)}) as iterator:
        assert {clip[0] for clip in clips(iterator, 6)} == {1, 2, 3}
    with pytest.raises(ValueError, match="short: none of 3 sequences has the 3 frames"):
        batches({"short": Numbered(3, num_frames=2)})


@pytest.mark.parametrize(
    "changes",
    [
        {"batch_size": 3, "process_count": 2},
        {"process_index": 1},
        {"weights": {"other": 1.0}},
        {"weights": {"numbered": 0.0}},
        {"seed": -1},
        {"clip_length": 0},
        {"stride": (3, 1)},
    ],
)
def test_bad_arguments_are_refused(changes: dict):
    with pytest.raises(ValueError, match="must"):
        batches(**changes)
