"""Data sets that are drawn on the device: their batches are descriptions, and what needs pictures is refused."""

import numpy as np
import pytest

from logvggt_jax.data.feeding.augmentation import ColourAugmentation
from logvggt_jax.data.feeding.batches import BatchIterator, training_batches
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.errors import InputError

ROOMS = Rooms("train", height=28, width=42, num_frames=8, num_rooms=8, renderer="device")
SCENES = ROOMS.for_training(cache_dir=None, progress=False)
AUGMENTATION = ColourAugmentation(
    shared=1.0, jitter=1.0, brightness=0.5, contrast=0, saturation=0, hue=0, grey=0, blur=0, blur_sigma=(0.1, 1.0)
)


def batches(**changes: object) -> BatchIterator:
    options: dict = {"clip_length": 3, "batch_size": 2, "sizes": [(28, 42)], "seed": 0, "num_threads": 0, **changes}
    return training_batches({"rooms": SCENES}, **options)


@pytest.mark.usefixtures("forked_workers")
def test_workers_describe_the_same_clips() -> None:
    with batches() as here, batches(worker_count=1, max_broken=0.1) as elsewhere:
        for _ in range(3):
            expected, found = next(here), next(elsewhere)
            assert expected.keys() == found.keys() >= {"boxes", "rotations", "extrinsics"} and "images" not in found
            for name, value in expected.items():
                np.testing.assert_array_equal(found[name], value)
        assert here.draw is not None


def test_descriptions_are_of_the_clips_that_pictures_would_show() -> None:
    options: dict = {"clip_length": 3, "batch_size": 2, "sizes": [(28, 42)], "seed": 0, "num_threads": 0}
    with batches() as described, training_batches({"rooms": ROOMS}, **options) as pictures:
        assert pictures.draw is None and pictures.get_state() == described.get_state()
        np.testing.assert_array_equal(next(described)["extrinsics"], next(pictures)["extrinsics"])


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"augmentation": AUGMENTATION}, "data.augmentation does not reach"),
        ({"sizes": [(28, 28)]}, r"at 28 x 42, and the stage asks for sizes \[\(28, 28\)\]"),
    ],
)
def test_what_needs_pictures_is_refused(changes: dict, named: str) -> None:
    with pytest.raises(InputError, match=f"rooms is drawn on the device.*{named}"):
        batches(**changes)


def test_they_are_not_mixed_with_pictures() -> None:
    with pytest.raises(InputError, match="cannot be mixed with others"):
        training_batches({"rooms": SCENES, "others": ROOMS}, clip_length=3, batch_size=2, sizes=[(28, 42)], seed=0)
