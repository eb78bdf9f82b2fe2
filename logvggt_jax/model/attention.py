"""Softmax attention behind one function, with a back end for each kind of device.

No back end keeps all scores: cuDNN's and the Pallas kernel are flash attention, the XLA form walks over heads
and blocks of queries (on a CPU that is also the fastest form, see `benchmarks/attention.py`).
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from absl import logging

from logvggt_jax.model.precision import product_precision

# Scores of one block: small enough for a CPU's cache hierarchy, large enough to keep matrix units busy.
_BLOCK_SCORES = {"cpu": 2**20, "gpu": 2**26, "tpu": 2**24}
# Below this many scores in all, one batched product beats any loop.
_SMALL_SCORES = 2**21
# Blocks of the TPU's kernel: large ones keep its matrix unit busy.
_TPU_BLOCKS = (512, 384, 256)
# Every score a masked key gets: finite, so that a row without any valid key stays finite.
_MASKED = -1e30


def attention(
    query: jax.Array,
    key: jax.Array,
    value: jax.Array,
    key_valid: jax.Array | None = None,
    *,
    implementation: str = "auto",
) -> jax.Array:
    """softmax(q kᵀ / √head_dim) v over the keys that are valid.

    Args:
      query: [B, queries, heads, head_dim].
      key: [B, keys, heads, head_dim], the query's dtype.
      value: [B, keys, heads, head_dim].
      key_valid: bool [B, keys], False for keys that nothing may attend to, or int32 [B], the first so many count;
        None for all. A row of B without any valid key gets finite values without meaning.
      implementation: `auto` (by the default device), `xla`, `cudnn` or `tpu_flash` (the Pallas kernel). What the
        last two cannot do takes `xla`, with one warning for each reason unless it is small.

    Returns:
      [B, queries, heads, head_dim] in the query's dtype; softmax in float32.
    """
    if implementation == "auto":
        implementation = {"gpu": "cudnn", "tpu": "tpu_flash"}.get(jax.default_backend(), "xla")
    kernel, obstacle = {
        "cudnn": (_cudnn, _cudnn_obstacle(query)),
        "tpu_flash": (_tpu_flash, _tpu_flash_obstacle(query, key)),
    }.get(implementation, (None, None))
    if kernel is not None and obstacle is None:
        return kernel(query, key, value, key_valid)
    key_valid = _as_mask(key_valid, key.shape[1])
    batch, queries, heads, _ = query.shape
    if batch * heads * queries * key.shape[1] <= _SMALL_SCORES:
        return _batched(query, key, value, key_valid)
    if obstacle is not None:
        _warn_once(f"attention falls back from {implementation} to the general form, which is slower: {obstacle}")
    return _blockwise(query, key, value, key_valid)


def _as_mask(key_valid: jax.Array | None, keys: int) -> jax.Array | None:
    """bool [B, keys] of either form of validity."""
    if key_valid is None or key_valid.ndim == 2:
        return key_valid
    return jnp.arange(keys) < key_valid[:, None]


def _weights(scores: jax.Array, valid: jax.Array | None) -> jax.Array:
    """Softmax of float32 scores [..., queries, keys] with `valid` broadcastable to them."""
    if valid is not None:
        scores = jnp.where(valid, scores, _MASKED)
    return jax.nn.softmax(scores, axis=-1)


def _batched(query: jax.Array, key: jax.Array, value: jax.Array, key_valid: jax.Array | None) -> jax.Array:
    scale = query.shape[-1] ** -0.5
    precision = product_precision(query.dtype)
    scores = jnp.einsum("bqhd,bkhd->bhqk", query * scale, key, precision=precision, preferred_element_type=jnp.float32)
    weights = _weights(scores, None if key_valid is None else key_valid[:, None, None, :])
    return jnp.einsum("bhqk,bkhd->bqhd", weights.astype(value.dtype), value, precision=precision)


def _blockwise(query: jax.Array, key: jax.Array, value: jax.Array, key_valid: jax.Array | None) -> jax.Array:
    """Exact attention, one block of queries of a few heads at a time; the backward pass recomputes a block."""
    batch, queries, heads, head_dim = query.shape
    keys, precision = key.shape[1], product_precision(query.dtype)
    block_scores = _BLOCK_SCORES.get(jax.default_backend(), 2**20)
    block = max(1, min(queries, block_scores // keys))
    heads_at_once = max(1, min(heads, block_scores // (block * keys)))
    while heads % heads_at_once:
        heads_at_once -= 1
    num_blocks = -(-queries // block)
    block = -(-queries // num_blocks)
    padded = jnp.pad(query * head_dim**-0.5, ((0, 0), (0, num_blocks * block - queries), (0, 0), (0, 0)))

    def split_heads(x: jax.Array) -> jax.Array:  # [B, N, heads, d] -> [B * groups, heads_at_once, N, d]
        x = jnp.swapaxes(x, 1, 2)
        return x.reshape(batch * heads // heads_at_once, heads_at_once, x.shape[2], head_dim)

    # One loop over everything: a nested one would give the compiler two small bodies to keep apart.
    q = split_heads(padded).reshape(-1, heads_at_once, num_blocks, block, head_dim)
    k, v = split_heads(key), split_heads(value)
    groups = k.shape[0]

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def one_block(index: jax.Array) -> jax.Array:
        group, position = index // num_blocks, index % num_blocks
        q_block = jax.lax.dynamic_index_in_dim(q, group, 0, keepdims=False)
        q_block = jax.lax.dynamic_index_in_dim(q_block, position, 1, keepdims=False)
        k_block = jax.lax.dynamic_index_in_dim(k, group, 0, keepdims=False)
        v_block = jax.lax.dynamic_index_in_dim(v, group, 0, keepdims=False)
        scores = jnp.einsum("hqd,hkd->hqk", q_block, k_block, precision=precision, preferred_element_type=jnp.float32)
        valid = None
        if key_valid is not None:
            valid = jax.lax.dynamic_index_in_dim(key_valid, group // (groups // batch), 0, keepdims=False)
        return jnp.einsum("hqk,hkd->hqd", _weights(scores, valid).astype(v.dtype), v_block, precision=precision)

    out = jax.lax.map(one_block, jnp.arange(groups * num_blocks))
    out = out.reshape(batch, heads // heads_at_once, num_blocks, heads_at_once, block, head_dim)
    out = out.transpose(0, 2, 4, 1, 3, 5).reshape(batch, num_blocks * block, heads, head_dim)
    return out[:, :queries]


@functools.cache
def _warn_once(message: str) -> None:
    logging.warning("%s", message)


def _cudnn_obstacle(query: jax.Array) -> str | None:
    """Why cuDNN cannot do it; head sizes up to 128 are what GPUs since Ampere take."""
    if query.dtype not in (jnp.bfloat16, jnp.float16):
        return f"cuDNN attention takes bfloat16 and float16, not {query.dtype}"
    if query.shape[-1] % 8 or query.shape[-1] > 128:
        return f"cuDNN attention takes heads of a multiple of 8 up to 128, not of {query.shape[-1]}"
    return None


def _tpu_flash_obstacle(query: jax.Array, key: jax.Array) -> str | None:
    """Why the TPU's kernel should not do it: it rounds float32 products, and pads keys to whole blocks."""
    if query.dtype != jnp.bfloat16:
        return f"the TPU's flash kernel takes bfloat16, not {query.dtype}"
    if key.shape[1] < min(_TPU_BLOCKS):
        return f"the TPU's flash kernel takes at least {min(_TPU_BLOCKS)} keys, not {key.shape[1]}"
    return None


def _cudnn(query: jax.Array, key: jax.Array, value: jax.Array, key_valid: jax.Array | None) -> jax.Array:
    """cuDNN flash attention. Validity becomes a length: attention does not care about the order of keys, so
    valid ones go first; a dense mask would cost a bias of queries x keys."""
    lengths = None
    if key_valid is not None and key_valid.ndim == 1:
        lengths = jnp.maximum(key_valid, 1).astype(jnp.int32)
    elif key_valid is not None:
        order = jnp.argsort(~key_valid, axis=1, stable=True)[..., None, None]
        key = jnp.take_along_axis(key, order, axis=1)
        value = jnp.take_along_axis(value, order, axis=1)
        lengths = jnp.maximum(key_valid.sum(1), 1).astype(jnp.int32)
    if query.shape[1] % 2 or key.shape[1] % 2:
        return _cudnn_of_odd_length(query, key, value, lengths)
    return _cudnn_call(query, key, value, lengths)


def _cudnn_call(query: jax.Array, key: jax.Array, value: jax.Array, lengths: jax.Array | None) -> jax.Array:
    return jax.nn.dot_product_attention(query, key, value, key_value_seq_lengths=lengths, implementation="cudnn")


# Odd lengths are refused under differentiation alone: inference does not pay for the padding.
_cudnn_of_odd_length = jax.custom_vjp(_cudnn_call)


def _cudnn_forward(query: jax.Array, key: jax.Array, value: jax.Array, lengths: jax.Array | None) -> Any:
    """The result and its backward pass, of queries and keys padded to even lengths; padding keys are masked."""
    if lengths is None:
        lengths = jnp.full(key.shape[0], key.shape[1], jnp.int32)

    def padded(query: jax.Array, key: jax.Array, value: jax.Array) -> jax.Array:
        q, k, v = (jnp.pad(x, ((0, 0), (0, x.shape[1] % 2), (0, 0), (0, 0))) for x in (query, key, value))
        return _cudnn_call(q, k, v, lengths)[:, : query.shape[1]]

    return jax.vjp(padded, query, key, value)


def _cudnn_backward(pull_back: Any, cotangent: jax.Array) -> tuple[Any, ...]:
    return (*pull_back(cotangent), None)


_cudnn_of_odd_length.defvjp(_cudnn_forward, _cudnn_backward)


def _tpu_flash(query: jax.Array, key: jax.Array, value: jax.Array, key_valid: jax.Array | None) -> jax.Array:
    """The Pallas TPU kernel. It wants whole blocks: queries and keys are padded, and padding and invalid keys
    get a segment of their own."""
    from jax.experimental.pallas.ops.tpu import flash_attention as pallas

    batch, queries, _, head_dim = query.shape
    keys = key.shape[1]
    q_block, k_block = _least_padding(queries), _least_padding(keys)
    valid = _as_mask(key_valid, keys)
    if valid is None:
        valid = jnp.ones((batch, keys), bool)

    def pad(x: jax.Array, block: int) -> jax.Array:
        return jnp.pad(x, ((0, 0), (0, -x.shape[1] % block)) + ((0, 0),) * (x.ndim - 2))

    query, key, value, valid = pad(query, q_block), *(pad(x, k_block) for x in (key, value, valid))
    segments = pallas.SegmentIds(q=jnp.ones(query.shape[:2], jnp.int32), kv=jnp.where(valid, 1, 0).astype(jnp.int32))
    sizes = pallas.BlockSizes(
        block_q=q_block,
        block_k_major=k_block,
        block_k=k_block,
        block_b=1,
        block_q_major_dkv=q_block,
        block_k_major_dkv=k_block,
        block_k_dkv=k_block,
        block_q_dkv=q_block,
        block_k_major_dq=k_block,
        block_k_dq=k_block,
        block_q_dq=q_block,
    )
    out = pallas.flash_attention(
        *(jnp.swapaxes(x, 1, 2) for x in (query, key, value)),
        segment_ids=segments,
        sm_scale=head_dim**-0.5,
        block_sizes=sizes,
    )
    return jnp.swapaxes(out, 1, 2)[:, :queries].astype(value.dtype)


def _least_padding(length: int) -> int:
    """The block that `length` fills up best, the largest of equals."""
    return min(_TPU_BLOCKS, key=lambda block: -length % block)
