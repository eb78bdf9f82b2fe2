"""The pre-norm transformer block that encoder, aggregator and camera head share, and its parts."""

from __future__ import annotations

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.model.attention import attention
from logvggt_jax.model.initializers import constant, fan_in_normal
from logvggt_jax.model.precision import product_precision
from logvggt_jax.model.rope import RopeTable, apply_rope


def dense(features: int, name: str, dtype: str = "float32", *, kernel_init: Any = fan_in_normal) -> nn.Dense:
    """Linear layer with a float32 kernel, products in `dtype` and sums in float32, unrounded."""
    return nn.Dense(
        features,
        dtype=dtype,
        precision=product_precision(dtype),
        dot_general=functools.partial(jax.lax.dot_general, preferred_element_type=jnp.float32),
        kernel_init=kernel_init,
        bias_init=constant(0.0),
        name=name,
    )


def layer_norm(epsilon: float, name: str, *, affine: bool = True) -> nn.LayerNorm:
    """LayerNorm over the last axis, in float32; PyTorch's variance (no E[x²] − E[x]² shortcut)."""
    return nn.LayerNorm(
        epsilon=epsilon,
        dtype=jnp.float32,
        use_bias=affine,
        use_scale=affine,
        use_fast_variance=False,
        scale_init=constant(1.0),
        bias_init=constant(0.0),
        name=name,
    )


class LayerScale(nn.Module):
    """A learned gain for each channel of a residual branch [..., C]; float32 out."""

    initial: float

    @nn.compact
    def __call__(self, branch: jax.Array) -> jax.Array:
        gamma = self.param("gamma", constant(self.initial), (branch.shape[-1],))
        return gamma * branch.astype(jnp.float32)


class MLP(nn.Module):
    """fc2(GELU(fc1(x))) with the exact (erf) GELU."""

    hidden: int
    features: int
    dtype: str

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        x = dense(self.hidden, "fc1", self.dtype)(x)
        x = jax.nn.gelu(x, approximate=False)
        return dense(self.features, "fc2", self.dtype)(x)


class Attention(nn.Module):
    """Multi-head attention of tokens [B, queries, C] to [B, keys, C], the queries' own tokens first.

    `qk_norm` normalises queries and keys per head, before the rotary embedding.
    """

    num_heads: int
    qk_norm: bool
    dtype: str
    implementation: str

    @nn.compact
    def __call__(
        self, x: jax.Array, context: jax.Array, rope: RopeTable | None, key_valid: jax.Array | None
    ) -> jax.Array:
        width = x.shape[-1]
        head_dim = width // self.num_heads
        query = dense(width, "query", self.dtype)(x)
        key, value = jnp.split(dense(2 * width, "key_value", self.dtype)(context), 2, axis=-1)
        query, key, value = (t.reshape(*t.shape[:-1], self.num_heads, head_dim) for t in (query, key, value))
        if self.qk_norm:
            query = layer_norm(1e-5, "query_norm")(query)
            key = layer_norm(1e-5, "key_norm")(key)
        if rope is not None:
            query = apply_rope(query, RopeTable(*(part[: query.shape[1]] for part in rope)))
            key = apply_rope(key, rope)
        out = attention(
            query.astype(self.dtype),
            key.astype(self.dtype),
            value.astype(self.dtype),
            key_valid,
            implementation=self.implementation,
        )
        return dense(width, "output", self.dtype)(out.reshape(x.shape))


class Block(nn.Module):
    """x + γ₁ Attn(LN(x)); x + γ₂ MLP(LN(x)), with an optional longer set of keys and values.

    The residual stream stays float32 whatever `dtype` the products use.
    """

    num_heads: int
    mlp_ratio: int
    epsilon: float
    layer_scale: float
    qk_norm: bool = False
    dtype: str = "float32"
    implementation: str = "auto"

    @nn.compact
    def __call__(
        self,
        x: jax.Array,
        *,
        rope: RopeTable | None = None,
        extra: jax.Array | None = None,
        key_valid: jax.Array | None = None,
    ) -> jax.Array:
        """Args: x [B, N, C] float32; `extra` [B, E, C], tokens that are keys and values only (cross-window
        attention), after the block's own; `rope` for the N + E keys; `key_valid` bool [B, N + E]."""
        width = x.shape[-1]
        norm1 = layer_norm(self.epsilon, "norm1")
        normed = norm1(x)
        context = normed if extra is None else jnp.concatenate([normed, norm1(extra)], axis=1)
        branch = Attention(self.num_heads, self.qk_norm, self.dtype, self.implementation, name="attention")(
            normed, context, rope, key_valid
        )
        x = x + LayerScale(self.layer_scale, name="scale1")(branch)
        branch = MLP(self.mlp_ratio * width, width, self.dtype, name="mlp")(layer_norm(self.epsilon, "norm2")(x))
        return x + LayerScale(self.layer_scale, name="scale2")(branch)
