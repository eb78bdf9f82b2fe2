"""Batches read ahead onto the devices: the state is that of the batch in hand, errors come in their turn."""

import jax
import numpy as np
import pytest

from logvggt_jax.data.feeding.batches import BatchIterator, training_batches
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.training.feeding.device_batches import DeviceBatches
from logvggt_jax.training.parallel.sharding import data_mesh, split


class Failing(Rooms):
    """Rooms of which one cannot be read."""

    def read(self, sequence, indices):
        if sequence == self.sequences[1]:
            raise OSError(f"{sequence}: cannot be read")
        return super().read(sequence, indices)


def source(rooms: type[Rooms] = Rooms, renderer: str = "host") -> BatchIterator:
    dataset = rooms("train", height=28, width=42, num_frames=4, num_rooms=8, renderer=renderer)
    options = {"clip_length": 2, "batch_size": 2, "sizes": [(28, 42)], "seed": 0, "num_threads": 0}
    read = dataset.for_training(cache_dir=None, progress=False) if renderer == "device" else dataset
    return training_batches({"rooms": read}, **options)


@pytest.mark.parametrize("ahead", [1, 3])
def test_reading_ahead_changes_neither_batches_nor_state(ahead: int) -> None:
    mesh = data_mesh(2)
    with source() as plain, source() as read, DeviceBatches(read, mesh, ahead=ahead) as batches:
        assert batches.get_state() == plain.get_state()
        for _ in range(5):
            expected, found = next(plain), next(batches)
            assert batches.get_state() == plain.get_state()
            for name, value in expected.items():
                assert isinstance(found[name], jax.Array) and found[name].sharding == split(mesh)
                np.testing.assert_array_equal(found[name], value)
        state = batches.get_state()
        expected = next(plain)
    with source() as resumed:
        resumed.set_state(state)
        with DeviceBatches(resumed, mesh) as batches:
            np.testing.assert_array_equal(next(batches)["depth"], expected["depth"])


def test_each_device_draws_its_own_clips() -> None:
    mesh = data_mesh(2)
    with source() as plain, source(renderer="device") as described, DeviceBatches(described, mesh) as batches:
        for _ in range(3):
            expected, found = next(plain), next(batches)
            assert found.keys() == expected.keys() and batches.get_state() == plain.get_state()
            for name, value in expected.items():
                assert found[name].sharding == split(mesh) and found[name].dtype == value.dtype
                assert np.abs(np.asarray(found[name], np.float64) - value).max() <= (1 if name == "images" else 1e-4)
        state, following = batches.get_state(), jax.device_get(next(batches))
    with source(renderer="device") as resumed:
        resumed.set_state(state)
        with DeviceBatches(resumed, mesh) as batches:
            for name, value in jax.device_get(next(batches)).items():
                np.testing.assert_array_equal(value, following[name])


@pytest.mark.parametrize("ahead", [1, 3])
def test_an_error_is_known_ahead_and_waits_for_the_batch_that_it_belongs_to(ahead: int) -> None:
    with source(Failing) as plain:
        good = 0
        with pytest.raises(OSError, match="cannot be read"):
            while True:
                next(plain)
                good += 1
    assert good == 3
    with source(Failing) as read, DeviceBatches(read, data_mesh(1), ahead=ahead) as batches:
        for left in range(good, 0, -1):
            assert batches.failure(min(ahead, left)) is None
            assert isinstance(batches.failure(ahead), OSError if left < ahead else type(None))
            next(batches)
        assert batches.get_state()["examples"] == 2 * good
        # However often: no later batch comes in its place.
        for _ in range(2):
            assert isinstance(batches.failure(1), OSError)
            with pytest.raises(OSError, match="cannot be read"):
                next(batches)
        assert batches.get_state()["examples"] == 2 * good
