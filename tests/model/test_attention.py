"""Every form of attention on this device computes the textbook formula."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl import logging
from jax.experimental.pallas import tpu as pallas_tpu

from logvggt_jax.described import cudnn_by_description
from logvggt_jax.model import attention as module
from logvggt_jax.model.attention import attention


def inputs(queries=37, keys=53, batch=2, heads=4, head_dim=8, dtype=np.float32):
    generator = np.random.default_rng(0)

    def tensor(count):
        return generator.standard_normal((batch, count, heads, head_dim)).astype(dtype)

    return tensor(queries), tensor(keys), tensor(keys)


def attended(*arguments, **options):
    """As one program, traced anew: forms are chosen while it is."""
    return jax.jit(functools.partial(attention, **options))(*arguments)


def textbook(query, key, value, valid=None):
    query, key, value = (np.asarray(x, np.float64) for x in (query, key, value))
    scores = np.einsum("bqhd,bkhd->bhqk", query, key) / np.sqrt(query.shape[-1])
    if valid is not None:
        scores = np.where(np.asarray(valid)[:, None, None, :], scores, -np.inf)
    weights = np.exp(scores - scores.max(-1, keepdims=True))
    weights /= weights.sum(-1, keepdims=True)
    return np.einsum("bhqk,bkhd->bqhd", weights, value)


@pytest.fixture(params=["batched", "blockwise", "blockwise, several heads at once"])
def form(request, monkeypatch):
    if request.param != "batched":
        monkeypatch.setattr(module, "_SMALL_SCORES", 0)
        scores = 53 * 10 if request.param == "blockwise" else 53 * 37 * 2
        monkeypatch.setattr(module, "_BLOCK_SCORES", {"cpu": scores})
    return request.param


@pytest.mark.parametrize("masked", [False, True])
def test_equals_the_textbook(form, masked):
    query, key, value = inputs()
    valid = np.random.default_rng(1).random((2, 53)) < 0.6 if masked else None
    out = attended(query, key, value, valid)
    np.testing.assert_allclose(out, textbook(query, key, value, valid), atol=2e-6)


def test_invalid_keys_have_no_influence_at_all(form):
    query, key, value = inputs()
    valid = np.arange(53)[None].repeat(2, 0) < 20
    compiled = jax.jit(functools.partial(attention))  # traced anew
    before = compiled(query, key, value, valid)
    key, value = (np.where(valid[..., None, None], x, np.float32(1e3)) for x in (key, value))
    after = compiled(query, key, value, valid)
    np.testing.assert_array_equal(before, after)


def test_a_row_without_valid_keys_is_finite(form):
    query, key, value = inputs()
    valid = np.array([[True] * 53, [False] * 53])
    out, gradient = jax.jit(jax.value_and_grad(lambda q: attention(q, key, value, valid).sum()))(query)
    assert np.isfinite(out)
    assert np.isfinite(gradient).all()


def test_gradients_agree_between_forms(monkeypatch):
    arguments = inputs()

    def gradients():
        return jax.jit(jax.grad(lambda args: (attention(*args) ** 2).sum()))(arguments)

    batched = gradients()
    monkeypatch.setattr(module, "_SMALL_SCORES", 0)
    monkeypatch.setattr(module, "_BLOCK_SCORES", {"cpu": 53 * 10})
    for a, b in zip(gradients(), batched, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_long_sequences_do_not_materialise_scores():
    shape = jax.ShapeDtypeStruct((1, 4096, 4, 16), jnp.float32)
    compiled = jax.jit(attention).lower(shape, shape, shape).compile()
    all_scores = 4 * 4096 * 4096 * 4
    assert compiled.memory_analysis().temp_size_in_bytes < all_scores / 8


def test_bfloat16_softmax_is_float32(form):
    query, key, value = inputs(dtype=jnp.bfloat16)
    out = attended(query, key, value)
    assert out.dtype == jnp.bfloat16
    np.testing.assert_allclose(np.asarray(out, np.float32), textbook(query, key, value), atol=2e-2)


@pytest.mark.parametrize("implementation", ["cudnn", "tpu_flash"])
def test_float32_never_takes_a_kernel_that_rounds(implementation):
    query, key, value = inputs(keys=520)
    out = attended(query, key, value, implementation=implementation)
    np.testing.assert_allclose(out, textbook(query, key, value), atol=2e-6)


@pytest.mark.parametrize(
    ("implementation", "sizes"), [("cudnn", {"head_dim": 12}), ("cudnn", {"head_dim": 136}), ("tpu_flash", {})]
)
def test_sizes_without_a_kernel_take_the_general_form(implementation, sizes):
    """Head sizes that cuDNN refuses; fewer keys than a block of the TPU's kernel."""
    query, key, value = inputs(dtype=jnp.bfloat16, **sizes)
    out = attended(query, key, value, implementation=implementation)
    np.testing.assert_array_equal(out, attended(query, key, value, implementation="xla"))


@pytest.mark.parametrize("masked", [False, True])
def test_validity_as_a_length_equals_validity_as_a_mask(monkeypatch, masked):
    """The call of cuDNN, answered by the general implementation: keys are reordered, valid ones first."""
    general = jax.nn.dot_product_attention

    def answer(*arguments, implementation, **options):
        assert implementation == "cudnn"
        return general(*arguments, implementation="xla", **options)

    monkeypatch.setattr(jax.nn, "dot_product_attention", answer)
    query, key, value = inputs(dtype=jnp.bfloat16)
    valid = np.random.default_rng(1).random((2, 53)) < 0.6 if masked else None
    out = attended(query, key, value, valid, implementation="cudnn")
    assert out.dtype == jnp.bfloat16
    np.testing.assert_allclose(np.asarray(out, np.float32), textbook(query, key, value, valid), atol=2e-2)


@pytest.mark.parametrize("masked", [False, True])
def test_the_tpu_kernel_computes_the_textbook(masked):
    """Interpreted on this device; neither queries nor keys are whole blocks."""
    query, key, value = inputs(queries=530, keys=600, heads=1, dtype=jnp.bfloat16)
    valid = np.random.default_rng(1).random((2, 600)) < 0.6 if masked else None
    with pallas_tpu.force_tpu_interpret_mode():
        out = attended(query, key, value, valid, implementation="tpu_flash")
    assert out.shape == query.shape
    assert out.dtype == jnp.bfloat16
    np.testing.assert_allclose(np.asarray(out, np.float32), textbook(query, key, value, valid), atol=2e-2)


@pytest.fixture
def cudnn_for_lowering():
    """JAX asks the GPU at hand about cuDNN; programs can be lowered without one."""
    with cudnn_by_description():
        yield


def gradients_of(*arguments, **options):
    return jax.grad(lambda qkv: (attention(*qkv, *arguments[3:], **options).astype(jnp.float32) ** 2).sum())(
        arguments[:3]
    )


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("queries", "keys"), [(1041, 1041), (1041, 1042), (1042, 1041), (1042, 1042)])
@pytest.mark.usefixtures("cudnn_for_lowering")
def test_cudnn_is_lowered_forward_and_backward_at_any_length(queries, keys, masked):
    query, key = (jax.ShapeDtypeStruct((2, n, 16, 64), jnp.bfloat16) for n in (queries, keys))
    valid = (jax.ShapeDtypeStruct((2, keys), bool),) if masked else ()
    differentiated = functools.partial(gradients_of, implementation="cudnn")
    text = jax.jit(differentiated).trace(query, key, key, *valid).lower(lowering_platforms=("cuda",)).as_text()
    assert (text.count("@__cudnn$fmhaSoftmax("), text.count("@__cudnn$fmhaSoftmaxBackward(")) == (1, 1)
    inference = jax.jit(functools.partial(attention, implementation="cudnn"))
    text = inference.trace(query, key, key, *valid).lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("@__cudnn$fmhaSoftmax(") == 1
    assert "stablehlo.pad" not in text, "inference needs no padding"


@pytest.mark.parametrize("masked", [False, True])
def test_padding_to_even_lengths_changes_no_gradient(monkeypatch, masked):
    """The call of cuDNN, answered by the general implementation, which sees even lengths alone."""
    general, lengths = jax.nn.dot_product_attention, set()

    def answer(query, key, value, *, implementation, **options):
        lengths.update((query.shape[1], key.shape[1]))
        return general(query, key, value, implementation="xla", **options)

    monkeypatch.setattr(jax.nn, "dot_product_attention", answer)
    arguments = inputs(queries=37, keys=53, dtype=jnp.bfloat16)
    valid = np.random.default_rng(1).random((2, 53)) < 0.6 if masked else None
    found, expected = (
        jax.jit(functools.partial(gradients_of, implementation=form))(*arguments, valid) for form in ("cudnn", "xla")
    )
    assert lengths == {38, 54}
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.asarray(a, np.float32), np.asarray(b, np.float32), atol=2e-2)


def test_each_fall_back_is_said_once(caplog, monkeypatch):
    attended(*inputs(), implementation="cudnn")
    assert not caplog.records, "what is small is not slower"
    monkeypatch.setattr(module, "_SMALL_SCORES", 0)
    logging.use_python_logging(quiet=True)
    module._warn_once.cache_clear()
    for _ in range(2):
        attended(*inputs(), implementation="cudnn")
        attended(*inputs(dtype=jnp.bfloat16), implementation="tpu_flash")
    messages = [record.message for record in caplog.records]
    assert len(messages) == 2
    assert "from cudnn" in messages[0] and "not float32" in messages[0]
    assert "from tpu_flash" in messages[1] and "at least 256 keys, not 53" in messages[1]


def test_the_tpu_kernel_stands_inside_shard_map():
    """It does not say over which devices its result varies, so that check has to be off, as in training."""
    shape = jax.ShapeDtypeStruct((2, 520, 2, 64), jnp.bfloat16)
    mesh = jax.make_mesh((2,), ("data",), axis_types=(jax.sharding.AxisType.Auto,))
    data = jax.P("data")
    differentiated = functools.partial(gradients_of, implementation="tpu_flash")
    sharded = jax.shard_map(differentiated, mesh=mesh, in_specs=(data,) * 3, out_specs=data, check_vma=False)
    program = jax.jit(sharded).trace(shape, shape, shape)
    assert str(program.jaxpr).count("pallas_call") >= 3, "forward, and backward for queries and for keys"
