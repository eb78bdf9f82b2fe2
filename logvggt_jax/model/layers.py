"""The pre-norm transformer block that encoder, aggregator and camera head share, and its parts."""

from __future__ import annotations

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
    """A linear layer whose kernel may come in eight bits, see `low_precision.py`; see `dense`."""

    sums: str = "float32"

    @nn.compact
    def __call__(self, inputs: jax.Array, *, columns: slice = slice(None), cuts: tuple[int, ...] = ()) -> Any:
        """Float32 [..., features], those of some `columns` of the kernel alone; with `cuts` a list of the parts between
        them. Biases are added after the cuts, by the kernels that read a part."""
        if self.has_variable("params", "codes"):
            given: Any = self.variables["params"]
            bias = given["bias"]
            sums = product(inputs, given["codes"][:, columns], given["scale"][:, columns])
        else:
            kernel = self.param("kernel", self.kernel_init, (inputs.shape[-1], self.features))
            bias = self.param("bias", self.bias_init, (self.features,)).astype(self.dtype)
            sums = jnp.matmul(
                inputs.astype(self.dtype),
                kernel[:, columns].astype(self.dtype),
                precision=self.precision,
                preferred_element_type=jnp.dtype(self.sums),
            )
        pairs = zip(jnp.split(sums, cuts, axis=-1), jnp.split(bias[columns], cuts), strict=True)
        parts = [part.astype(jnp.float32) + added.astype(jnp.float32) for part, added in pairs]
        return parts if cuts else parts[0]


def dense(
    features: int, name: str, dtype: str = "float32", *, sums: str = "float32", kernel_init: Any = fan_in_normal
) -> _Dense:
    """Linear layer: products of `dtype`, summed in float32, which leave the matrix unit in `sums`; the bias is added in
    float32, and the result is float32. Wide sums in 16 bits are half of the memory traffic, and where the next product
    rounds what they become they cost little accuracy."""
    return _Dense(
        features,
        sums=sums,
        dtype=dtype,
        precision=product_precision(dtype),
        kernel_init=kernel_init,
        bias_init=constant(0.0),
        name=name,
    )


def sums_of(dtype: str) -> str:
    """The type in which wide sums of products of `dtype` are handed on: bfloat16 has float32's range, float16 not."""
    return "bfloat16" if dtype == "bfloat16" else "float32"


def layer_norm(
    epsilon: float, name: str, dtype: str = "float32", *, affine: bool = True, in_one_pass: bool = False
) -> nn.LayerNorm:
    """LayerNorm over the last axis, in float32, of what products of `dtype` read.

    For float32 products PyTorch's variance; for 16-bit ones the shortcut E[x²] − E[x]², whose error their rounding
    hides: both sums come out of the kernel that makes the tokens. `in_one_pass` keeps PyTorch's variance there too, for
    tokens that nothing else has to write: XLA's GPU compiler knows this form, and reads them once, in one kernel.
    """
    return LayerNorm(
        epsilon=epsilon,
        dtype=jnp.float32,
        use_bias=affine,
        use_scale=affine,
        use_fast_variance=dtype != "float32" and not in_one_pass,
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
    """x Φ(x) of float32 values that products of `dtype` read: exact, or to 3e-7 where they round it to 16 bits."""
    return jax.nn.gelu(x, approximate=False) if dtype == "float32" else _gelu_before_rounding(x)


@jax.custom_jvp
def _gelu_before_rounding(x: jax.Array) -> jax.Array:
    """An elementary Φ costs a GPU little more than reading and writing the values, of which `erf` costs half again."""
    return x * _normal_distribution(x)


@_gelu_before_rounding.defjvp
def _gelu_slope(values: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    (x,), (tangent,) = values, tangents
    below = _normal_distribution(x)
    density = math.sqrt(0.5 / math.pi) * jnp.exp(-0.5 * x * x)
    return x * below, (below + x * density) * tangent


def _normal_distribution(x: jax.Array) -> jax.Array:
    """Φ(x) to 1e-7 (Abramowitz and Stegun, Handbook of Mathematical Functions, 7.1.26), in the lower tail to a few
    thousandths of its value."""
    t = 1.0 / (1.0 + 0.3275911 * math.sqrt(0.5) * jnp.abs(x))
    series = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))))
    tail = 0.5 * series * jnp.exp(-0.5 * x * x)
    return jnp.where(x < 0, tail, 1.0 - tail)


class MLP(nn.Module):
    """fc2(GELU(fc1(x))) with the exact GELU, see `_gelu`."""

    hidden: int
    features: int
    dtype: str

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        x = dense(self.hidden, "fc1", self.dtype, sums=sums_of(self.dtype))(x)
        x = _gelu(x, self.dtype).astype(self.dtype)
        return dense(self.features, "fc2", self.dtype, sums=sums_of(self.dtype))(x)


class Attention(nn.Module):
    """Multi-head attention in four parts, between which a memory can come in; the block puts them together.

    `project` makes queries and keys of the block's own tokens, `keys` those of others; `attend` lets queries see keys
    and has no parameters, and calling the module projects the result back to the residual stream. With `qk_norm`
    queries and keys are normalised per head, before the rotary embedding, in float32. Parameters for streams have the
    projections side by side, as `query_key_value`, see `parameters.in_compute_type`.
    """

    num_heads: int
    width: int
    qk_norm: bool
    dtype: str
    implementation: str

    def setup(self) -> None:
        self.query = dense(self.width, "query", self.dtype, sums=sums_of(self.dtype))
        self.key_value = dense(2 * self.width, "key_value", self.dtype, sums=sums_of(self.dtype))
        self.query_key_value = dense(3 * self.width, "query_key_value", self.dtype, sums=sums_of(self.dtype))
        self.output = dense(self.width, "output", self.dtype, sums=sums_of(self.dtype))
        if self.qk_norm:
            self.query_norm = layer_norm(1e-5, "query_norm", self.dtype)
            self.key_norm = layer_norm(1e-5, "key_norm", self.dtype)

    def project(
        self, normed: jax.Array, rope: RopeTable | None, valid: jax.Array | None = None
    ) -> tuple[jax.Array, Keys]:
        """Queries [B, N, heads, head_dim] and keys, in the compute type, of tokens [B, N, C] after the block's
        LayerNorm; see `Keys`."""
        if self._joint:
            query, key, value = self.query_key_value(normed, cuts=(self.width, 2 * self.width))
        else:
            query, (key, value) = self.query(normed), self.key_value(normed, cuts=(self.width,))
        query = self._heads(query)
        if self.qk_norm:
            query = self.query_norm(query)
        query = (query if rope is None else apply_rope(query, rope)).astype(self.dtype)
        return query, self._keys(key, value, rope, valid)

    def keys(self, normed: jax.Array, rope: RopeTable | None) -> Keys:
        """Keys and values in the compute type of tokens [B, N, C] after the block's LayerNorm."""
        if self._joint:
            key, value = self.query_key_value(normed, columns=slice(self.width, None), cuts=(self.width,))
        else:
            key, value = self.key_value(normed, cuts=(self.width,))
        return self._keys(key, value, rope, None)

    def _keys(self, key: jax.Array, value: jax.Array, rope: RopeTable | None, valid: jax.Array | None) -> Keys:
        key = self._heads(key)
        if self.qk_norm:
            key = self.key_norm(key)
        key = key if rope is None else apply_rope(key, rope)
        return Keys(key.astype(self.dtype), self._heads(value).astype(self.dtype), valid)

    def attend(self, query: jax.Array, keys: Keys) -> jax.Array:
        """The softmax-weighted mean of the values for each query [B, Q, heads, head_dim], in the same shape."""
        return attention(query, keys.key, keys.value, keys.valid, implementation=self.implementation)

    def __call__(self, taken: jax.Array) -> jax.Array:
        """The residual branch [B, N, C], before its LayerScale, of what `attend` gave, [B, N, heads, head_dim]."""
        return self.output(taken.reshape(*taken.shape[:2], self.width))

    @property
    def _joint(self) -> bool:
        return self.has_variable("params", "query_key_value")

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
        # Token by token, for any number of frames at once: so the same kernels serve frame and global blocks.
        rows, shape = x.reshape(-1, width), x.shape
        normed = norm1(rows).reshape(shape)
        own = OwnTokens(normed, *attention_.project(normed, rope, valid))
        if memory is None:
            taken = attention_.attend(own.query, own.keys)
        else:
            taken, memory = memory.attend(own, attention_.attend, lambda tokens: attention_.keys(norm1(tokens), rope))
        rows += LayerScale(self.layer_scale, name="scale1")(attention_(taken).reshape(-1, width))
        branch = MLP(self.mlp_ratio * width, width, self.dtype, name="mlp")(
            layer_norm(self.epsilon, "norm2", self.dtype, in_one_pass=True)(rows)
        )
        return (rows + LayerScale(self.layer_scale, name="scale2")(branch)).reshape(shape), memory
