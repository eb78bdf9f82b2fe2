"""Of an update whose gradient is not finite the clips are found that made it so."""

from typing import Any

import jax
import numpy as np
import pytest
from dazzled_model import DazzledModel

from logvggt_jax.training.config import LossConfig
from logvggt_jax.training.parallel.sharding import data_mesh, parameter_layout, put_batch
from logvggt_jax.training.step.finite_check import failing, make_finite_check, non_finite_clips
from logvggt_jax.training.step.train_step import make_loss_terms

Clips = dict[str, np.ndarray]


@pytest.mark.parametrize(
    ("bad", "count", "most"),
    [
        ({5}, 16, 9),
        ({0, 15}, 16, 17),
        (set(range(16)), 16, 17),
        (set(), 16, 1),
        ({0}, 1, 1),
        ({2}, 3, 5),
        ({700}, 1024, 21),
    ],
)
def test_clips_are_found_by_halving(bad: set[int], count: int, most: int) -> None:
    tries = []

    def fails(group: np.ndarray) -> bool:
        tries.append(group)
        return bool(bad & set(group.tolist()))

    assert set(failing(fails, count)) == bad
    assert len(tries) <= most


def test_clips_that_fail_together_alone_are_all_named() -> None:
    assert failing(lambda group: {4, 9} <= set(group.tolist()), 16) == list(range(16))
    assert failing(lambda group: {4, 5} <= set(group.tolist()), 16) == [4, 5]


def test_what_is_not_told_apart_in_time_is_named() -> None:
    bad = set(range(0, 1024, 3))
    found = failing(lambda group: bool(bad & set(group.tolist())), 1024)
    assert bad <= set(found)


def test_the_clip_whose_gradient_is_not_finite_is_found_among_finite_losses(
    layered: Any, loss_config: LossConfig, layered_params: Any, clips: Clips
) -> None:
    images = clips["images"].copy()
    images[[2, 5]] = 255
    white = {**clips, "images": images}
    terms = make_loss_terms(DazzledModel(layered.config, layered), loss_config)
    _, _, finite = jax.jit(terms)(layered_params, white)
    assert finite.all()
    # Parameters in parts, of which every device gets the gradient of all clips, and clips one after the other.
    layout = parameter_layout(layered_params, data_mesh(4), shard=True)
    check = make_finite_check(terms, loss_config, layout, accumulate=2)
    params = layout.put(layered_params)

    def found(clips: Clips) -> list[int]:
        return np.flatnonzero(non_finite_clips(check, params, put_batch(clips, layout.mesh), layout)).tolist()

    assert found(white) == [2, 5]
    assert not found(clips)
    # A clip that counts in no term may still have a slope that is not finite, times zero.
    unseen = np.where(np.isin(np.arange(8), [2, 5])[:, None, None, None], 0.0, clips["depth"])
    assert found({**white, "depth": unseen}) == [2, 5]
