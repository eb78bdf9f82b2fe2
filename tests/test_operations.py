"""Operations counted by shapes, through loops, branches and devices."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest
from jax.sharding import PartitionSpec as P

from logvggt_jax.operations import count_flops

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


def test_what_a_gradient_computes_again_can_be_left_out() -> None:
    gradient = jax.grad(lambda x: jax.checkpoint(lambda x: jnp.sin(x @ x) @ x)(x).sum())
    # The first product is there again in the backward pass, which takes two for each.
    assert count_flops(gradient, MATRIX) == 7 * PRODUCT
    assert count_flops(gradient, MATRIX, recomputed=False) == 6 * PRODUCT


def test_a_loop_without_fixed_trips_is_an_error() -> None:
    def until_large(x: jax.Array) -> jax.Array:
        return jax.lax.while_loop(lambda y: y[0, 0] < 10, lambda y: y @ y, x)

    with pytest.raises(ValueError, match="trips of a loop is not fixed"):
        count_flops(until_large, MATRIX)


def test_convolutions_count_window_and_channels() -> None:
    def convolve(x: jax.Array, kernel: jax.Array, stride: int = 1) -> jax.Array:
        return jax.lax.conv_general_dilated(
            x, kernel, (stride, stride), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )

    images = jax.ShapeDtypeStruct((2, 8, 10, 3), jnp.float32)
    kernel = jax.ShapeDtypeStruct((3, 3, 3, 5), jnp.float32)
    products = 2 * (2 * 8 * 10 * 5) * (3 * 3 * 3)
    assert count_flops(convolve, images, kernel) == products
    assert count_flops(lambda x, k: convolve(x, k, 2), images, kernel) == products / 4

    # The gradient's two convolutions cost what the convolution does each, that of the strided one too.
    for stride in (1, 2):
        gradient = jax.grad(lambda x, k, s=stride: convolve(x, k, s).sum(), argnums=(0, 1))
        assert count_flops(gradient, images, kernel) == pytest.approx(3 * products / stride**2, rel=0.3)

    depthwise = jax.ShapeDtypeStruct((3, 3, 1, 3), jnp.float32)
    grouped = count_flops(
        lambda x, k: jax.lax.conv_general_dilated(
            x, k, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"), feature_group_count=3
        ),
        images,
        depthwise,
    )
    assert grouped == 2 * (2 * 8 * 10 * 3) * 9


def test_products_count_batch_and_contraction() -> None:
    left, right = jax.ShapeDtypeStruct((7, 5, 3, 11), jnp.bfloat16), jax.ShapeDtypeStruct((7, 13, 3, 11), jnp.bfloat16)
    assert count_flops(lambda q, k: jnp.einsum("bqhd,bkhd->bhqk", q, k), left, right) == 2 * 7 * 3 * 5 * 13 * 11
    assert count_flops(lambda x: jnp.exp(x) + x, MATRIX) == 0


def test_of_branches_the_dearest_counts() -> None:
    def either(x: jax.Array) -> jax.Array:
        return jax.lax.cond(x[0, 0] > 0, lambda y: y, lambda y: y @ y @ y, x)

    assert count_flops(either, MATRIX) == 2 * PRODUCT


def test_functions_with_derivatives_of_their_own_count() -> None:
    square = jax.custom_vjp(lambda x: x @ x)
    square.defvjp(lambda x: (x @ x, x), lambda x, g: (g @ x.T + x.T @ g,))
    assert count_flops(square, MATRIX) == PRODUCT
    assert count_flops(jax.grad(lambda x: square(x).sum()), MATRIX) == 3 * PRODUCT


def test_every_device_counts_its_share() -> None:
    mesh = jax.make_mesh((4,), ("data",), axis_types=(jax.sharding.AxisType.Auto,))
    rows = jax.ShapeDtypeStruct((8, 64, 64), jnp.float32)
    square = jax.shard_map(lambda x: x @ x, mesh=mesh, in_specs=P("data"), out_specs=P("data"))
    assert count_flops(square, rows) == 8 * PRODUCT


def test_no_backend_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """CUDA's has no counts: every figure was 0 there."""
    monkeypatch.setattr(jax.stages.Lowered, "cost_analysis", lambda _: None)
    assert count_flops(lambda x: repeated(x, 7), MATRIX) == 7 * PRODUCT
