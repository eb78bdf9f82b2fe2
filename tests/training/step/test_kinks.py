"""What rounding does at the kinks of the depth head's rectifiers: where it comes from that gradients on different
numbers of devices may differ by more than rounding, and why that is harmless."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.config import DPTConfig
from logvggt_jax.model.dpt_head import DPTHead

SIZE, GRID = (28, 42), (2, 3)
HIDDEN = "output_2_hidden"


@pytest.mark.slow
def test_a_unit_that_rounding_moves_across_zero_changes_the_gradient_by_its_share_and_the_loss_by_nothing() -> None:
    """The last rectifier sees 32 numbers a pixel, millions a batch: now and then one lies within rounding of zero."""
    head = DPTHead(DPTConfig(features=8, out_channels=(8, 8, 8, 8)), 2, "float32")
    generator = np.random.default_rng(0)
    levels = [generator.standard_normal((4, 6, 16)).astype(np.float32) for _ in range(4)]
    target = generator.standard_normal((4, *SIZE)).astype(np.float32)
    dense = {"grid": GRID, "image_size": SIZE}
    params = jax.jit(lambda: head.init(jax.random.key(0), levels, **dense))()["params"]

    @jax.jit
    @jax.value_and_grad
    def loss(params: dict) -> jax.Array:
        return jnp.abs(head.apply({"params": params}, levels, **dense)[..., 0] - target).mean()

    @jax.jit
    def before(params: dict) -> jax.Array:
        seen = head.apply(
            {"params": params},
            levels,
            **dense,
            capture_intermediates=lambda module, _: module.name == HIDDEN,
            mutable=["intermediates"],
        )
        return seen[1]["intermediates"][HIDDEN]["__call__"][0]

    def on_one_side(sign: int) -> dict:
        bias = params[HIDDEN]["bias"].at[channel].add(sign * 1e-6 - nearest)
        return {**params, HIDDEN: {**params[HIDDEN], "bias": bias}}

    values = np.asarray(before(params))
    place = np.unravel_index(np.abs(values).argmin(), values.shape)
    nearest, channel = values[place], place[-1]
    below, above = on_one_side(-1), on_one_side(1)
    crossed = (np.asarray(before(below)) > 0) != (np.asarray(before(above)) > 0)
    assert crossed[place] and crossed.sum() == 1

    (loss_below, gradient_below), (loss_above, gradient_above) = loss(below), loss(above)
    assert abs(loss_below - loss_above) < 1e-6 * loss_above
    jump = _norm(jax.tree.map(jnp.subtract, gradient_above, gradient_below)) / _norm(gradient_above)
    # One of 150,000 units: a batch of clips has a thousand times as many, and the jump is as much smaller.
    assert 1e-6 < jump < 1e-3, "above rounding, and no more than a unit's share"


def _norm(tree: dict) -> float:
    return float(jnp.sqrt(sum((leaf**2).sum() for leaf in jax.tree.leaves(tree))))
