"""Operations counted through loops."""

import jax
import jax.numpy as jnp
import pytest

from logvggt_jax.evaluation.costs.operations import count_flops

MATRIX = jax.ShapeDtypeStruct((64, 64), jnp.float32)
PRODUCT = 2 * 64**3


def repeated(x: jax.Array, times: int) -> jax.Array:
    return jax.lax.scan(lambda carry, _: (carry @ x, None), x, length=times)[0]


def test_a_loop_counts_as_often_as_it_runs() -> None:
    assert count_flops(lambda x: x @ x, MATRIX) == PRODUCT
    assert count_flops(lambda x: repeated(x, 7), MATRIX) == pytest.approx(7 * PRODUCT, rel=1e-3)
    # Under a jit, beside something else, and in a map whose last batch is smaller.
    assert count_flops(lambda x: jax.jit(repeated, static_argnums=1)(x, 3) @ x, MATRIX) == pytest.approx(
        4 * PRODUCT, rel=1e-3
    )
    rows = jax.ShapeDtypeStruct((10, 64, 64), jnp.float32)
    mapped = count_flops(lambda x: jax.lax.map(lambda row: row @ row, x, batch_size=4), rows)
    assert mapped == pytest.approx(10 * PRODUCT, rel=1e-3)


def test_loops_in_loops_multiply() -> None:
    def nested(x: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda carry, _: (repeated(carry, 5) @ x, None), x, length=3)[0]

    assert count_flops(nested, MATRIX) == pytest.approx(3 * 6 * PRODUCT, rel=1e-3)


def test_a_checkpointed_loop_is_found() -> None:
    assert count_flops(jax.checkpoint(lambda x: repeated(x, 4)), MATRIX) == pytest.approx(4 * PRODUCT, rel=1e-3)


def test_a_loop_without_fixed_trips_is_an_error() -> None:
    def until_large(x: jax.Array) -> jax.Array:
        return jax.lax.while_loop(lambda y: y[0, 0] < 10, lambda y: y @ y, x)

    with pytest.raises(ValueError, match="trips of a loop is not fixed"):
        count_flops(until_large, MATRIX)
