"""DINOv2 ViT with registers: one frame's image to normalised patch tokens."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.config import EncoderConfig
from logvggt_jax.model.initializers import constant, fan_in_normal, normal
from logvggt_jax.model.layers import Block, layer_norm, with_special
from logvggt_jax.model.parameters import given, run
from logvggt_jax.model.precision import product_precision
from logvggt_jax.model.shape_check import ShapeCheck

IMAGE_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_IMAGE_STD = np.array([0.229, 0.224, 0.225], np.float32)


class PatchEmbedding(ShapeCheck, nn.Module):
    """Convolution with kernel = stride = patch, as one matrix product over flattened patches."""

    features: int
    patch_size: int
    dtype: str

    @nn.compact
    def __call__(self, images: jax.Array) -> jax.Array:
        """[N, H, W, 3] -> [N, h * w, C], row by row."""
        size = self.patch_size
        shape = (size, size, images.shape[-1], self.features)
        kernel = self.param("kernel", fan_in_normal, shape)
        bias = self.param("bias", constant(0.0), (self.features,))
        count, height, width, channels = images.shape
        patches = images.reshape(count, height // size, size, width // size, size, channels)
        patches = patches.transpose(0, 1, 3, 2, 4, 5).reshape(count, -1, size * size * channels)
        dtype = jnp.dtype(self.dtype)
        matrix = kernel.reshape(-1, self.features).astype(dtype)
        return jnp.matmul(patches.astype(dtype), matrix, precision=product_precision(dtype)) + bias.astype(dtype)


class DinoV2(ShapeCheck, nn.Module):
    """Images [N, H, W, 3], float32 in [0, 1], to patch tokens [N, h * w, C] float32 (h = H/14, w = W/14).

    Blocks run one after the other or, where their parameters come stacked, as one loop; see `Aggregator`. Nothing
    attends to the patches that `seen`, bool [N, h * w], leaves out; None for none.
    """

    config: EncoderConfig
    dtype: str
    implementation: str
    remat: bool = False

    @nn.compact
    def __call__(self, images: jax.Array, seen: jax.Array | None = None) -> jax.Array:
        config = self.config
        width, side = config.embed_dim, config.position_grid
        tokens = PatchEmbedding(width, config.patch_size, self.dtype, name="patch_embed")(
            (images - IMAGE_MEAN) / _IMAGE_STD
        ).astype(jnp.float32)
        tiny, small = normal(1e-6), normal(0.02)
        cls_token = self.param("cls_token", tiny, (1, 1, width))
        pos_embed = self.param("pos_embed", small, (1, 1 + side * side, width))
        registers = self.param("register_tokens", tiny, (1, config.num_registers, width))
        # Part of every DINOv2 checkpoint; only masked-image pre-training reads it.
        self.param("mask_token", constant(0.0), (1, width))

        grid = (images.shape[1] // config.patch_size, images.shape[2] // config.patch_size)
        tokens = tokens + _resize_positions(pos_embed[:, 1:], side, grid)
        first = jnp.concatenate([cls_token + pos_embed[:, :1], registers], axis=1)
        x = jnp.concatenate([jnp.broadcast_to(first, (len(tokens), *first.shape[1:])), tokens], axis=1)
        valid = None if seen is None else with_special(seen, first.shape[1])

        def block(**options: Any) -> Block:
            return Block(
                config.num_heads,
                config.mlp_ratio,
                epsilon=1e-6,
                layer_scale=1.0,
                dtype=self.dtype,
                implementation=self.implementation,
                **options,
            )

        detached = block(parent=None)

        def layer(x: jax.Array, params: Any) -> tuple[jax.Array, None]:
            return run(detached, params, x, valid=valid)[0], None

        if self.has_variable("params", "blocks"):
            body = jax.checkpoint(layer, prevent_cse=False) if self.remat else layer
            x, _ = jax.lax.scan(body, x, self.get_variable("params", "blocks"))
        else:
            for i in range(config.depth):
                name = f"block_{i}"
                own = self.get_variable("params", name) if given(self, name) else None
                x, _ = block(name=name)(x, valid=valid) if own is None else layer(x, own)
        return layer_norm(1e-6, "norm", self.dtype)(x[:, 1 + config.num_registers :])


def _resize_positions(pos_embed: jax.Array, side: int, grid: tuple[int, int]) -> jax.Array:
    """Position embedding [1, side², C] resampled to [1, h * w, C] by antialiased bicubic interpolation."""
    if grid == (side, side):
        return pos_embed
    width = pos_embed.shape[-1]
    square = pos_embed.reshape(side, side, width)
    resized = jax.image.resize(square, (*grid, width), "bicubic", antialias=True, precision=jax.lax.Precision.HIGHEST)
    return resized.reshape(1, -1, width)
