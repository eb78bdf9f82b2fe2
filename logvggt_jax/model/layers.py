"""The pre-norm transformer block that encoder, aggregator and camera head share, and its parts."""

from __future__ import annotations

import functools
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.model.attention import attention
from logvggt_jax.model.initializers import constant, fan_in_normal
from logvggt_jax.model.low_precision import product
from logvggt_jax.model.memory import Keys, LayerMemory, OwnTokens
from logvggt_jax.model.precision import product_precision
from logvggt_jax.model.rope import RopeTable, apply_rope
from logvggt_jax.model.shape_check import Dense, LayerNorm, ShapeCheck


class _Dense(Dense):
    """A linear layer whose kernel may come in eight bits, see `low_precision.py`; its result is of type `out`."""

    out: str = "float32"

    def __call__(self, inputs: jax.Array) -> jax.Array:
        if not self.has_variable("params", "codes"):
            return super().__call__(inputs)
        given: Any = self.variables["params"]
        return (product(inputs, given["codes"], given["scale"]) + given["bias"]).astype(self.out)


def dense(
    features: int, name: str, dtype: str = "float32", *, out: str = "float32", kernel_init: Any = fan_in_normal
) -> nn.Dense:
    """Linear layer: products of `dtype`, summed in float32 and handed out in `out`, float32 unless what follows would
    round it anyway. Wide sums that leave the matrix unit in 16 bits are half of the memory traffic."""
    return _Dense(
        features,
        out=out,
        dtype=dtype,
        precision=product_precision(dtype),
        dot_general=functools.partial(jax.lax.dot_general, preferred_element_type=jnp.dtype(out)),
        kernel_init=kernel_init,
        bias_init=constant(0.0),
        name=name,
    )


def layer_norm(epsilon: float, name: str, dtype: str = "float32", *, affine: bool = True) -> nn.LayerNorm:
    """LayerNorm over the last axis, in float32, of what products of `dtype` read.

    For float32 products PyTorch's variance; for 16-bit ones the shortcut E[x²] − E[x]², whose error their rounding
    hides and which reads the tokens once less.
    """
    return LayerNorm(
        epsilon=epsilon,
        dtype=jnp.float32,
        use_bias=affine,
        use_scale=affine,
        use_fast_variance=dtype != "float32",
        scale_init=constant(1.0),
        bias_init=constant(0.0),
        name=name,
    )


class LayerScale(ShapeCheck, nn.Module):
    """A learned gain for each channel of a residual branch [..., C]; float32 out."""

    initial: float

    @nn.compact
    def __call__(self, branch: jax.Array) -> jax.Array:
        gamma = self.param("gamma", constant(self.initial), (branch.shape[-1],))
        return gamma * branch.astype(jnp.float32)


def with_special(seen: jax.Array, count: int) -> jax.Array:
    """Which of a frame's tokens count, bool [..., count + h * w]: its `count` special ones, which come first, and the
    patches that are `seen`, bool [..., h * w]."""
    return jnp.pad(seen, [*[(0, 0)] * (seen.ndim - 1), (count, 0)], constant_values=True)


def _gelu(x: jax.Array, dtype: str) -> jax.Array:
    """x Φ(x), exact, of float32 values that products of `dtype` read.

    Φ by erfc keeps the relative accuracy of its tail, which 16-bit products round away: by erf it costs half.
    """
    if dtype == "float32":
        return jax.nn.gelu(x, approximate=False)
    return x * (0.5 + 0.5 * jax.lax.erf(x * math.sqrt(0.5)))


class MLP(nn.Module):
    """fc2(GELU(fc1(x))) with the exact (erf) GELU."""

    hidden: int
    features: int
    dtype: str

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        x = dense(self.hidden, "fc1", self.dtype, out=self.dtype)(x)
        x = _gelu(x.astype(jnp.float32), self.dtype).astype(self.dtype)
        return dense(self.features, "fc2", self.dtype)(x)


class Attention(nn.Module):
    """Multi-head attention in four parts, between which a memory can come in; the block puts them together.

    `queries` and `keys` project the block's tokens, `attend` lets queries see keys and has no parameters, and calling
    the module projects the result back to the residual stream. With `qk_norm` queries and keys are normalised per head,
    before the rotary embedding.
    """

    num_heads: int
    width: int
    qk_norm: bool
    dtype: str
    implementation: str

    def setup(self) -> None:
        # Norm and rotation want what the products would round off.
        out = "float32" if self.qk_norm else self.dtype
        self.query = dense(self.width, "query", self.dtype, out=out)
        self.key_value = dense(2 * self.width, "key_value", self.dtype, out=out)
        self.output = dense(self.width, "output", self.dtype)
        if self.qk_norm:
            self.query_norm = layer_norm(1e-5, "query_norm", self.dtype)
            self.key_norm = layer_norm(1e-5, "key_norm", self.dtype)

    def queries(self, normed: jax.Array, rope: RopeTable | None) -> jax.Array:
        """Queries [B, N, heads, head_dim] in the compute type of tokens [B, N, C] after the block's LayerNorm."""
        query = self._heads(self.query(normed))
        if self.qk_norm:
            query = self.query_norm(query)
        return (query if rope is None else apply_rope(query, rope)).astype(self.dtype)

    def keys(self, normed: jax.Array, rope: RopeTable | None, valid: jax.Array | None = None) -> Keys:
        """Keys and values in the compute type of tokens [B, N, C] after the block's LayerNorm; see `Keys`."""
        key, value = (self._heads(x) for x in jnp.split(self.key_value(normed), 2, axis=-1))
        if self.qk_norm:
            key = self.key_norm(key)
        key = key if rope is None else apply_rope(key, rope)
        return Keys(key.astype(self.dtype), value.astype(self.dtype), valid)

    def attend(self, query: jax.Array, keys: Keys) -> jax.Array:
        """The softmax-weighted mean of the values for each query [B, Q, heads, head_dim], in the same shape."""
        return attention(query, keys.key, keys.value, keys.valid, implementation=self.implementation)

    def __call__(self, taken: jax.Array) -> jax.Array:
        """The residual branch [B, N, C], before its LayerScale, of what `attend` gave, [B, N, heads, head_dim]."""
        return self.output(taken.reshape(*taken.shape[:2], self.width))

    def _heads(self, x: jax.Array) -> jax.Array:
        return x.reshape(*x.shape[:-1], self.num_heads, self.width // self.num_heads)


class Block(nn.Module):
    """x + γ₁ Attn(LN(x)), then x + γ₂ MLP(LN(x)): the pre-norm transformer block of DINOv2 and VGGT.

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
        valid: jax.Array | None = None,
        memory: LayerMemory | None = None,
    ) -> tuple[jax.Array, LayerMemory | None]:
        """Tokens after the block, and the memory that it leaves.

        Every token of `x` is a query. It attends to the tokens of `x` that count and to what `memory` adds; tokens that
        a memory has stored pass through this block's own LayerNorm and projections:

            x ← x + γ₁ · Attn(Q(LN(x)), [K(LN(x)), K(LN(stored))], [V(LN(x)), V(LN(stored))])
            x ← x + γ₂ · MLP(LN(x))

        Args:
          x: [B, n · P, C] float32, the tokens of n frames, frame after frame.
          rope: rotary table of one frame's P tokens; None for tokens without a position.
          valid: which tokens of `x` count, in one of the forms of `Keys.valid`; a memory may ask for a certain one. No
            token attends to the others.
          memory: what the block has seen before; None for its own tokens alone.
        """
        width = x.shape[-1]
        norm1 = layer_norm(self.epsilon, "norm1", self.dtype)
        attention_ = Attention(self.num_heads, width, self.qk_norm, self.dtype, self.implementation, name="attention")
        normed = norm1(x)
        own = OwnTokens(normed, attention_.queries(normed, rope), attention_.keys(normed, rope, valid))
        if memory is None:
            taken = attention_.attend(own.query, own.keys)
        else:
            taken, memory = memory.attend(own, attention_.attend, lambda tokens: attention_.keys(norm1(tokens), rope))
        x = x + LayerScale(self.layer_scale, name="scale1")(attention_(taken))
        branch = MLP(self.mlp_ratio * width, width, self.dtype, name="mlp")(
            layer_norm(self.epsilon, "norm2", self.dtype)(x)
        )
        return x + LayerScale(self.layer_scale, name="scale2")(branch), memory
