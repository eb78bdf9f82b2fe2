"""Batches: shapes, coverage, shards, exact resume, and bad data named or replaced."""

import json
import multiprocessing
from itertools import islice

import numpy as np
import pytest
from absl import logging

from logvggt_jax.data.errors import MissingFiles
from logvggt_jax.data.feeding import batches as feeding
from logvggt_jax.data.feeding.augmentation import ColourAugmentation
from logvggt_jax.data.feeding.batches import training_batches
from logvggt_jax.data.feeding.broken_clips import TooManyBrokenClips
from logvggt_jax.data.feeding.frame_range import FrameRange
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames


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
        array[np.asarray(indices) == 0, 0, 0] = self.value
        return frames._replace(**{self.field: array})


class Shaped(Numbered):
    """Like `Numbered`; sequences with a number that three divides are upright."""

    def image_size(self, sequence: str) -> tuple[int, int]:
        return (28, 14) if int(sequence[1:]) % 3 == 0 else (14, 28)

    def read(self, sequence: str, indices) -> Frames:
        frames = super().read(sequence, indices)
        if self.image_size(sequence) == (14, 28):
            return frames
        intrinsics = frames.intrinsics.copy()
        intrinsics[:, :2, 2] = 7, 14
        images, depth = frames.images.transpose(0, 2, 1, 3), frames.depth.transpose(0, 2, 1)
        return frames._replace(images=images, depth=depth, intrinsics=intrinsics)


class Flaky(Numbered):
    """Like `Numbered`; frame 4 cannot be opened, and sequence 3 not at all."""

    def read(self, sequence: str, indices) -> Frames:
        if sequence == "s3" or 4 in indices:
            raise OSError(f"{sequence}/{indices[0]}.png: input/output error")
        return super().read(sequence, indices)


class Gone(Numbered):
    """Like `Numbered`; nothing can be read."""

    def read(self, sequence: str, indices) -> Frames:
        raise MissingFiles(f"{sequence}.png: no such file")


def batches(datasets=None, **changes):
    options = {"clip_length": 3, "batch_size": 4, "sizes": [(14, 28)], "seed": 5, "stride": (1, 3), **changes}
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
    """Results of runs depend on it. Who changes these clips changes `order` in the state of the data as well."""
    with batches() as iterator:
        drawn = clips(iterator, 2)
    assert drawn == [
        (6, 2, 5, 8),
        (4, 0, 2, 4),
        (3, 2, 3, 4),
        (5, 1, 4, 7),
        (0, 2, 4, 6),
        (2, 8, 6, 4),
        (1, 5, 6, 7),
        (7, 2, 4, 6),
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
    with pytest.raises(InputError, match="photographs: its frames have no order in time, and its clips no stride"):
        batches({"photographs": Photographs(4)}, strides={"photographs": (1, 4)})


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


@pytest.mark.usefixtures("forked_workers")
def test_workers_that_are_killed_are_started_again_a_few_times(monkeypatch):
    warnings = []
    monkeypatch.setattr(logging, "warning", lambda text, *values: warnings.append(text % values))

    def kill_a_worker():
        next(child for child in multiprocessing.active_children() if "grain" in child.name).kill()

    with batches() as iterator:
        expected = clips(iterator, 12)
    with batches(worker_count=2) as iterator:
        seen = clips(iterator, 1)
        kill_a_worker()
        # A few clips were read ahead by the other.
        seen += clips(iterator, 11)
        assert seen == expected
        assert len(warnings) == 1 and "exit code -9" in warnings[0] and "(1 of 3 times)" in warnings[0]
        monkeypatch.setattr(feeding, "_MOST_RESTARTS", 1)
        kill_a_worker()
        with pytest.raises(InputError, match=r"killed 2 times .*exit code -9.*fewer data\.worker_count"):
            clips(iterator, 12)


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


def test_a_batch_holds_one_size_and_no_picture_is_turned_into_another():
    with batches({"shaped": Shaped(12)}, sizes=[(14, 28), (28, 14)]) as iterator:
        drawn = [next(iterator)["images"] for _ in range(60)]
    for images in drawn:
        upright = {int(clip[0, 0, 0, 0]) % 3 == 0 for clip in images}
        assert upright == {images.shape[2:4] == (28, 14)}
    # A third of the sequences is upright.
    assert sum(images.shape[2] == 28 for images in drawn) == 20
    seen = [int(clip[0, 0, 0, 0]) for images in drawn for clip in images]
    assert {seen.count(sequence) for sequence in range(12)} == {20}


def test_weights_hold_across_sizes():
    mixture = {"wide": Numbered(5, first=100), "both": Shaped(6)}
    mixture["wide"].image_size = lambda sequence: (14, 28)
    with batches(mixture, sizes=[(14, 28), (28, 14)], weights={"wide": 1.0, "both": 3.0}) as iterator:
        drawn = [next(iterator)["images"] for _ in range(80)]
    sequences = [int(clip[0, 0, 0, 0]) for images in drawn for clip in images]
    assert sum(sequence >= 100 for sequence in sequences) / 320 == pytest.approx(0.25, abs=0.01)
    assert sum(sequence in (0, 3) for sequence in sequences) / 320 == pytest.approx(0.25, abs=0.01)


@pytest.mark.usefixtures("forked_workers")
def test_batches_of_several_sizes_resume_exactly_and_are_shared_by_processes():
    options = {"datasets": {"shaped": Shaped(12)}, "sizes": [(14, 28), (28, 14)]}

    def drawn(iterator, count):
        return [(batch["images"].shape[2:4], batch["images"][:, :, 0, 0].tolist()) for batch in islice(iterator, count)]

    with batches(**options) as iterator:
        before, state, after = drawn(iterator, 5), json.loads(json.dumps(iterator.get_state())), drawn(iterator, 7)
    assert len({size for size, _ in after}) == 2
    with batches(**options, worker_count=2, num_threads=1) as iterator:
        iterator.set_state(state)
        assert drawn(iterator, 7) == after
    shares = []
    for process in range(2):
        with batches(**options, process_index=process, process_count=2) as iterator:
            shares.append(drawn(iterator, 5))
    for (size, clips_), (size_0, even), (size_1, odd) in zip(before, *shares, strict=True):
        assert size == size_0 == size_1
        assert [clip for pair in zip(even, odd, strict=True) for clip in pair] == clips_
    with batches(**options, batch_size=8) as iterator, pytest.raises(ValueError, match="fields"):
        iterator.set_state({name: value for name, value in state.items() if name != "batch_size"})
    with batches(**options, batch_size=8) as iterator, pytest.raises(ValueError, match="batch_size=4, this run has 8"):
        iterator.set_state(state)


@pytest.mark.parametrize("unreadable", ["first", "later"])
def test_a_sequence_keeps_the_size_of_its_clips_whenever_its_pictures_can_be_read(unreadable):
    class Unread(Shaped):
        def image_size(self, sequence: str) -> tuple[int, int]:
            if sequence == "s3":
                raise OSError("s3/0.png: input/output error")
            return super().image_size(sequence)

    options = {"sizes": [(14, 28), (28, 14)], "max_broken": 0.9}
    first, later = (Unread(12), Shaped(12)) if unreadable == "first" else (Shaped(12), Unread(12))

    def drawn(iterator):
        return [(batch["images"].shape, batch["images"][:, 0, 0, 0, 0].tolist()) for batch in islice(iterator, 9)]

    with batches({"shaped": first}, **options) as iterator:
        next(iterator)
        state = json.loads(json.dumps(iterator.get_state()))
        following = drawn(iterator)
    with batches({"shaped": later}, **options, state=state) as iterator:
        assert [shape for shape, _ in drawn(iterator)] == [shape for shape, _ in following]
    # A state of before sizes were kept goes on where nothing has changed.
    del state["shapes"]
    with batches({"shaped": first}, **options, state=state) as iterator:
        assert drawn(iterator) == following
    with pytest.raises(ValueError, match="sequences="):
        batches({"shaped": later}, **options, state=state)


def test_a_broken_clip_is_replaced_by_the_next_of_its_set(caplog: pytest.LogCaptureFixture):
    logging.use_python_logging(quiet=True)
    options = {"stride": (1, 1), "max_broken": 0.5}
    with batches(**options) as iterator:
        intact = clips(iterator, 12)
    with batches({"numbered": Flaky(8)}, **options) as iterator:
        drawn = clips(iterator, 10)
        broken = iterator.broken
    readable = [clip[0] != 3 and 4 not in clip[1:] for clip in intact]
    expected = [next(clip for clip, good in zip(intact[i:], readable[i:], strict=True) if good) for i in range(40)]
    assert drawn == expected
    replaced = [i for i in range(40) if not readable[i]]
    assert broken.count == len(replaced) > 5
    assert all(message.startswith("OSError: s") and ".png: input" in message for message in broken.messages)
    assert caplog.text.count("broken clip, replaced") == broken.count


@pytest.mark.usefixtures("forked_workers")
def test_replaced_clips_are_the_same_after_resuming_and_for_any_number_of_workers():
    options = {"datasets": {"flaky": Flaky(8)}, "stride": (1, 1), "max_broken": 0.5}
    with batches(**options) as iterator:
        clips(iterator, 5)
        state = json.loads(json.dumps(iterator.get_state()))
        expected, total = clips(iterator, 5), iterator.broken.get_state()
    assert 0 < state["broken"]["count"] < total["count"]
    for workers in (0, 2):
        with batches(**options, worker_count=workers) as iterator:
            iterator.set_state(state)
            assert clips(iterator, 5) == expected and iterator.broken.get_state() == total


def test_too_many_broken_clips_end_the_run_with_their_names():
    with (
        batches({"flaky": Flaky(8)}, stride=(1, 1), max_broken=0.01) as iterator,
        pytest.raises(
            TooManyBrokenClips, match=r"1[1-4] of \d+ clips were broken.*allows 10: OSError: s\d/\d.png.*; OS"
        ),
    ):
        clips(iterator, 100)


def test_a_set_that_cannot_be_read_at_all_ends_the_run():
    with (
        batches({"gone": Gone(8)}, max_broken=0.9) as iterator,
        pytest.raises(ValueError, match=r"gone, pictures for 14 x 28: 16 clips in a row are broken: s\d.png"),
    ):
        next(iterator)


class WithoutUpright(Shaped):
    """Like `Shaped`; no upright sequence can be read."""

    def read(self, sequence: str, indices) -> Frames:
        if int(sequence[1:]) % 3 == 0:
            raise InputError(f"{sequence}/calibration.txt: missing")
        return super().read(sequence, indices)


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_shape_of_which_all_is_broken_is_replaced_by_the_other_shapes_of_its_set(workers):
    options = {"sizes": [(14, 28), (28, 14)], "max_broken": 0.9}
    with batches({"shaped": Shaped(90)}, **options) as iterator:
        shapes = [next(iterator)["images"].shape[2:4] for _ in range(12)]
    datasets = {"shaped": WithoutUpright(90)}
    with batches(datasets, **options) as iterator:
        drawn = [next(iterator) for _ in range(6)]
        state = json.loads(json.dumps(iterator.get_state()))
        drawn += [next(iterator) for _ in range(6)]
        total = iterator.broken.get_state()
    upright = [batch for batch in drawn if batch["images"].shape[2:4] == (28, 14)]
    assert [batch["images"].shape[2:4] for batch in drawn] == shapes and len(upright) > 2
    # Each broken clip once, and none of them in a batch.
    assert total["count"] == 4 * len(upright)
    assert all(int(clip[0, 0, 0, 0]) % 3 for batch in drawn for clip in batch["images"])
    assert len({clip[:, 0, 0, :2].tobytes() for batch in upright for clip in batch["images"]}) > 4
    with batches(datasets, **options, worker_count=workers) as iterator:
        iterator.set_state(state)
        for expected in drawn[6:]:
            batch = next(iterator)
            assert all(np.array_equal(batch[name], expected[name]) for name in expected)
        assert iterator.broken.get_state() == total


def test_a_set_of_which_all_is_broken_is_replaced_by_the_others_until_too_many_are():
    options = {"datasets": {"gone": Gone(300), "numbered": Numbered(30)}, "weights": {"gone": 0.1, "numbered": 0.9}}
    with batches(**options, max_broken=0.2) as iterator:
        assert {clip[0] for clip in clips(iterator, 10)} == set(range(30))
        assert 2 < iterator.broken.count < 6 and all("no such file" in text for text in iterator.broken.messages)
    with batches(**options, max_broken=0.05) as iterator, pytest.raises(TooManyBrokenClips, match=r"s\d+.png: no such"):
        clips(iterator, 200)


def test_broken_clips_are_a_share_of_all_clips_whatever_the_number_of_processes():
    """Five of five hundred are within one in a hundred, on however few processes the run goes on."""
    options = {"datasets": {"numbered": Numbered(8)}, "batch_size": 16, "max_broken": 0.006}
    with batches(**options) as iterator:
        state = iterator.get_state()
    state |= {"examples": 16_000, "broken": {"count": 60, "clips": 16_000, "messages": ["gone"]}}
    with batches(**options, process_index=0, process_count=16) as iterator:
        iterator.set_state(state)
        next(iterator)
        assert iterator.broken.get_state() == {"count": 60, "clips": 16_001, "messages": ["gone"]}
    with batches(**options, process_index=3, process_count=16) as iterator:
        iterator.set_state(state)
        next(iterator)
        assert iterator.broken.get_state() == {"count": 0, "clips": 1, "messages": []}, "process 0 counts on"


def test_a_sequence_that_cannot_be_listed_changes_no_other_clip():
    class Unlisted(Numbered):
        def num_frames(self, sequence: str) -> int:
            if sequence == "s3":
                raise InputError("s3/poses.txt: expected 16 numbers")
            return super().num_frames(sequence)

    with batches(max_broken=0.5) as iterator:
        intact, state = clips(iterator, 4), iterator.get_state()
    with batches({"numbered": Unlisted(8)}, max_broken=0.5) as iterator:
        drawn = clips(iterator, 4)
        own = ("broken", "frames")
        assert {name: value for name, value in iterator.get_state().items() if name not in own} == {
            name: value for name, value in state.items() if name not in own
        }
        assert iterator.broken.messages == ["s3/poses.txt: expected 16 numbers"]
        iterator.set_state(state)
    assert [clip for clip in intact if clip[0] != 3] == [b for a, b in zip(intact, drawn, strict=True) if a[0] != 3]
    with pytest.raises(ValueError, match="s3/poses"):
        batches({"numbered": Unlisted(8)})


def test_an_error_costs_no_clip_of_its_batch():
    class Mended(Numbered):
        broken = True

        def read(self, sequence: str, indices) -> Frames:
            if self.broken and sequence == "s5":
                raise OSError("network is down")
            return super().read(sequence, indices)

    with batches() as iterator:
        expected = clips(iterator, 2)
    dataset = Mended(8)
    with batches({"mended": dataset}) as iterator:
        with pytest.raises(OSError, match="network is down"):
            clips(iterator, 2)
        assert iterator.get_state()["examples"] == 0
        dataset.broken = False
        assert clips(iterator, 2) == expected


def test_clips_with_too_little_depth_are_broken():
    class Sparse(Numbered):
        def read(self, sequence: str, indices) -> Frames:
            frames = super().read(sequence, indices)
            depth = frames.depth.copy()
            depth[:, :, int(sequence[1:]) :] = 0
            return frames._replace(depth=depth)

    # Sequence n has depth in n of 28 columns.
    options = {"datasets": {"sparse": Sparse(8)}, "max_broken": 0.9}
    with batches(**options, min_valid_depth=3 / 28) as iterator:
        assert {clip[0] for clip in clips(iterator, 8)} == {3, 4, 5, 6, 7}
        assert any("0.00% of the pixels have depth" in message for message in iterator.broken.messages)
    with batches(**options) as iterator:
        assert {clip[0] for clip in clips(iterator, 8)} == set(range(8))


def test_augmented_clips_are_reproducible_and_keep_depth_and_cameras():
    options = dict.fromkeys(("jitter", "brightness", "contrast", "saturation", "grey"), 0.5)
    augmentation = ColourAugmentation(**options, shared=0.5, hue=0.1, blur=0.5, blur_sigma=(0.5, 1.0))
    rooms = {"rooms": Rooms("train", height=28, width=42, num_frames=6, num_rooms=4)}

    def drawn(**changes):
        with batches(rooms, sizes=[(28, 42)], **changes) as iterator:
            return [next(iterator) for _ in range(3)]

    plain, once, again = drawn(), drawn(augmentation=augmentation), drawn(augmentation=augmentation)
    for a, b, c in zip(plain, once, again, strict=True):
        assert all(np.array_equal(a[name], b[name]) for name in ("depth", "intrinsics", "extrinsics"))
        assert not np.array_equal(a["images"], b["images"]) and np.array_equal(b["images"], c["images"])


def test_state_of_other_data_is_refused():
    with batches() as iterator:
        state = iterator.get_state()
        with pytest.raises(ValueError, match="seed=6, this run has 5"):
            iterator.set_state({**state, "seed": 6})
        with pytest.raises(ValueError, match="sequences="):
            iterator.set_state({**state, "sequences": {"numbered": ["8 0123456789ab"]}})
        with pytest.raises(ValueError, match="fields"):
            iterator.set_state({"examples": 3})


def test_a_recording_that_grew_is_not_gone_on_with_as_if_it_had_not():
    def part(count: int) -> dict[str, FrameRange]:
        return {"numbered": FrameRange(Numbered(2, num_frames=count), (None, -4), "numbered")}

    with batches(part(9)) as iterator:
        state = json.loads(json.dumps(iterator.get_state()))
    with batches(part(12)) as iterator:
        with pytest.raises(InputError, match=r"numbered, s0 had frames 0:5 and has 0:8 now; .*new --workdir"):
            iterator.set_state(state)
        # Earlier versions did not write them down.
        iterator.set_state({name: value for name, value in state.items() if name != "frames"})


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
    with pytest.raises(ValueError, match=r"short: none of 3 sequences has the 3 frames .*; the longest has 2: shorten"):
        batches({"short": Numbered(3, num_frames=2)})
    with pytest.raises(ValueError, match=r"the longest has 0 of the frames that are asked for: shorten"):
        batches({"short": FrameRange(Numbered(3, num_frames=9), (None, -200), "short")})


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
        {"sizes": []},
        {"sizes": [(14, 28), (50, 70)], "max_broken": 0.9},
        {"max_broken": 1.0},
        {"min_valid_depth": -0.1},
    ],
)
def test_bad_arguments_are_refused(changes: dict):
    with pytest.raises(ValueError, match="must"):
        batches(**changes)
