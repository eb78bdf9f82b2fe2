"""DPT: the four key layers' patch tokens to a dense map with confidence."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.config import DPTConfig
from logvggt_jax.model.convolution import Convolution
from logvggt_jax.model.initializers import constant, normal
from logvggt_jax.model.layers import layer_norm
from logvggt_jax.model.precision import product_precision
from logvggt_jax.model.shape_check import ShapeCheck


class DPTHead(nn.Module):
    """`out_channels` values a pixel, the last one the raw confidence. Frames are independent."""

    config: DPTConfig
    out_channels: int
    dtype: str

    @nn.compact
    def __call__(self, levels: Sequence[jax.Array], *, grid: tuple[int, int], image_size: tuple[int, int]) -> jax.Array:
        """Patch tokens of the key layers, four times [N, h * w, 2C], to [N, H, W, out_channels] float32."""
        config, aspect = self.config, image_size[1] / image_size[0]
        norm = layer_norm(1e-5, "norm", self.dtype)
        maps = []
        for i, (tokens, channels) in enumerate(zip(levels, config.out_channels, strict=True)):
            x = norm(tokens).reshape(-1, *grid, tokens.shape[-1])
            x = Convolution(channels, 1, self.dtype, name=f"project_{i}")(x)
            x = x + uv_embedding(x.shape[1:], aspect).astype(x.dtype)
            if i < 2:
                x = UpConv(channels, 4 // 2**i, self.dtype, name=f"resize_{i}")(x)
            elif i == 3:
                x = Convolution(channels, 3, self.dtype, strides=2, name="resize_3")(x)
            maps.append(Convolution(config.features, 3, self.dtype, use_bias=False, name=f"layer_{i + 1}")(x))

        x = self._fuse(4, maps[3], None, _size(maps[2]))
        x = self._fuse(3, x, maps[2], _size(maps[1]))
        x = self._fuse(2, x, maps[1], _size(maps[0]))
        x = self._fuse(1, x, maps[0], (2 * maps[0].shape[1], 2 * maps[0].shape[2]))
        x = Convolution(config.features // 2, 3, self.dtype, name="output_1")(x)
        x = _resize_bilinear(x, image_size)
        x = x + uv_embedding(x.shape[1:], aspect).astype(x.dtype)
        x = jax.nn.relu(Convolution(32, 3, self.dtype, name="output_2_hidden")(x))
        return Convolution(self.out_channels, 1, self.dtype, name="output_2")(x).astype(jnp.float32)

    def _fuse(self, level: int, x: jax.Array, lateral: jax.Array | None, size: tuple[int, int]) -> jax.Array:
        return Fusion(self.config.features, self.dtype, name=f"refine_{level}")(x, lateral, size)


class UpConv(ShapeCheck, nn.Module):
    """Transposed convolution with kernel = stride: every pixel becomes a k x k tile."""

    features: int
    factor: int
    dtype: str

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        k = self.factor
        shape = (k, k, x.shape[-1], self.features)
        kernel = self.param("kernel", normal(x.shape[-1] ** -0.5), shape)
        bias = self.param("bias", constant(0.0), (self.features,))
        dtype = jnp.dtype(self.dtype)
        tiles = jnp.einsum(
            "nijc,abco->niajbo", x.astype(dtype), kernel.astype(dtype), precision=product_precision(dtype)
        )
        count, height, _, width, _, _ = tiles.shape
        return tiles.reshape(count, height * k, width * k, self.features) + bias.astype(dtype)


class ResidualUnit(nn.Module):
    """conv(relu(conv(r))) + r with r = relu(x): VGGT's in-place activation turns the skip into relu(x)."""

    features: int
    dtype: str

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        r = jax.nn.relu(x)
        x = Convolution(self.features, 3, self.dtype, name="conv1")(r)
        return Convolution(self.features, 3, self.dtype, name="conv2")(jax.nn.relu(x)) + r


class Fusion(nn.Module):
    """Adds a level's residual unit, refines, resizes to `size`, mixes channels."""

    features: int
    dtype: str

    @nn.compact
    def __call__(self, x: jax.Array, lateral: jax.Array | None, size: tuple[int, int]) -> jax.Array:
        if lateral is not None:
            x = x + ResidualUnit(self.features, self.dtype, name="residual_1")(lateral)
        x = ResidualUnit(self.features, self.dtype, name="residual_2")(x)
        x = _resize_bilinear(x, size)
        return Convolution(self.features, 1, self.dtype, name="output")(x)


def depth_activation(raw: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Depth exp(v) and confidence 1 + exp(c), float32 [...], of raw values [..., 2]."""
    return jnp.exp(raw[..., 0]), 1.0 + jnp.exp(raw[..., 1])


def point_activation(raw: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Points sign(v) (e^|v| − 1), [..., 3], and confidence 1 + exp(c), [...], of raw values [..., 4]."""
    values = raw[..., :3]
    return jnp.sign(values) * jnp.expm1(jnp.abs(values)), 1.0 + jnp.exp(raw[..., 3])


def _size(x: jax.Array) -> tuple[int, int]:
    return x.shape[1], x.shape[2]


def _interpolation(source: int, target: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear interpolation with both ends aligned (align_corners): the two neighbours of each of `target` places,
    int [target] both, and the share of the upper one, float32 [target]."""
    positions = np.zeros(target) if target == 1 else np.arange(target) * ((source - 1) / (target - 1))
    lower = np.minimum(np.floor(positions).astype(int), max(source - 2, 0))
    return lower, np.minimum(lower + 1, source - 1), (positions - lower).astype(np.float32)


def _interpolation_matrix(source: int, target: int, dtype: Any) -> jax.Array:
    """[target, source] weights of `_interpolation`. The program holds a number a row and makes the matrix by itself."""
    lower, upper, share = (jnp.asarray(each)[:, None] for each in _interpolation(source, target))
    column = jnp.arange(source)
    return (jnp.where(column == lower, 1.0 - share, 0.0) + jnp.where(column == upper, share, 0.0)).astype(dtype)


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def _resize_bilinear(x: jax.Array, size: tuple[int, int]) -> jax.Array:
    """[N, h, w, C] to [N, *size, C], corners aligned, which `jax.image.resize` does not offer.

    GPUs read the neighbours, which costs the traffic of the result alone; elsewhere, and backwards, where reading
    would become scattered additions, matrix products are faster.
    """
    if _size(x) == size:
        return x
    return jax.lax.platform_dependent(
        x, cuda=functools.partial(_from_neighbours, size=size), default=functools.partial(_by_products, size=size)
    )


def _from_neighbours(x: jax.Array, size: tuple[int, int]) -> jax.Array:
    for axis in (1, 2):
        lower, upper, share = _interpolation(x.shape[axis], size[axis - 1])
        weight = jnp.asarray(share).reshape(-1, *(1,) * (3 - axis))
        below, above = (jnp.take(x, places, axis=axis).astype(jnp.float32) for places in (lower, upper))
        x = (below + (above - below) * weight).astype(x.dtype)
    return x


def _by_products(x: jax.Array, size: tuple[int, int]) -> jax.Array:
    rows = _interpolation_matrix(x.shape[1], size[0], x.dtype)
    columns = _interpolation_matrix(x.shape[2], size[1], x.dtype)
    precision = product_precision(x.dtype)
    x = jnp.einsum("yh,nhwc->nywc", rows, x, precision=precision)
    return jnp.einsum("xw,nywc->nyxc", columns, x, precision=precision)


def _resize_forward(x: jax.Array, size: tuple[int, int]) -> tuple[jax.Array, jax.Array]:
    # The shape is all that the backward pass needs to know of x.
    return _resize_bilinear(x, size), jnp.zeros((0, *x.shape[1:]), x.dtype)


def _resize_backward(size: tuple[int, int], shape: jax.Array, cotangent: jax.Array) -> tuple[jax.Array]:
    if shape.shape[1:3] == size:
        return (cotangent,)
    like = jax.ShapeDtypeStruct((len(cotangent), *shape.shape[1:]), shape.dtype)
    return jax.linear_transpose(functools.partial(_by_products, size=size), like)(cotangent)


_resize_bilinear.defvjp(_resize_forward, _resize_backward)


def uv_embedding(shape: tuple[int, ...], aspect: float) -> jax.Array:
    """0.1 times the sinusoidal code, float32 [h, w, D], of a map's normalised coordinates; x half first.

    `aspect` is the image's W / H; coordinates span a box of unit half-diagonal. Phases are formed in float64. The
    program holds one row a line of the map and spreads it over the map by itself.
    """
    height, width, channels = shape
    diagonal = math.sqrt(aspect**2 + 1.0)
    span_x, span_y = aspect / diagonal * (width - 1) / width, 1.0 / diagonal * (height - 1) / height
    frequencies = 100.0 ** (-np.arange(channels // 4) / (channels / 4))

    def code(extent: float, count: int) -> jax.Array:
        phase = np.linspace(-extent, extent, count)[:, None] * frequencies
        return jnp.asarray((0.1 * np.concatenate([np.sin(phase), np.cos(phase)], axis=-1)).astype(np.float32))

    half = (height, width, channels // 2)
    x = jnp.broadcast_to(code(span_x, width)[None], half)
    y = jnp.broadcast_to(code(span_y, height)[:, None], half)
    return jnp.concatenate([x, y], axis=-1)
