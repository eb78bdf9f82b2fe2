"""Global camera consistency refinement: camera tokens attend to the register tokens of the whole sequence."""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.model.attention import attention
from logvggt_jax.model.initializers import constant
from logvggt_jax.model.layers import dense, layer_norm, sums_of


class RegisterKeys(NamedTuple):
    """Keys and values that frames' register tokens give to GCCR.

    Those of a frame do not depend on other frames: a stream projects each frame once.

    Attributes:
      key: [B, M, 4, 2C] compute dtype.
      value: [B, M, 4, 2C] compute dtype.
    """

    key: jax.Array
    value: jax.Array


class GCCR(nn.Module):
    """c' = c + O(Attn(Q(LN(c)), K(LN(R)), V(LN(R)))) (paper, equation of GCCR, with a residual).

    O starts at zero, so that a converted VGGT is unchanged.
    """

    width: int
    num_heads: int
    dtype: str
    implementation: str

    def setup(self) -> None:
        self.camera_norm = layer_norm(1e-5, "camera_norm")
        self.register_norm = layer_norm(1e-5, "register_norm")
        self.query = dense(self.width, "query", self.dtype, sums=sums_of(self.dtype))
        self.key = dense(self.width, "key", self.dtype, sums=sums_of(self.dtype))
        self.value = dense(self.width, "value", self.dtype, sums=sums_of(self.dtype))
        self.output = dense(self.width, "output", self.dtype, kernel_init=constant(0.0))

    def __call__(self, camera_tokens: jax.Array, register_tokens: jax.Array, frames: jax.Array) -> jax.Array:
        """[B, N, 2C], [B, M, 4, 2C] and the frames whose registers count -> [B, N, 2C]; see `attend`."""
        return self.attend(camera_tokens, self.project(register_tokens), frames)

    def project(self, register_tokens: jax.Array) -> RegisterKeys:
        """Keys and values of register tokens [B, M, 4, 2C]."""
        normed = self.register_norm(register_tokens)
        return RegisterKeys(self.key(normed).astype(self.dtype), self.value(normed).astype(self.dtype))

    def attend(self, camera_tokens: jax.Array, registers: RegisterKeys, frames: jax.Array) -> jax.Array:
        """Refined tokens [B, N, 2C] of camera tokens [B, N, 2C].

        `frames` says whose registers count: bool [B, M], or the first so many, int32 [B].
        """
        a_frame = registers.key.shape[2]
        queries = self.query(self.camera_norm(camera_tokens)).astype(self.dtype)

        def heads(tokens: jax.Array) -> jax.Array:
            return tokens.reshape(len(tokens), -1, self.num_heads, self.width // self.num_heads)

        out = attention(
            heads(queries),
            heads(registers.key),
            heads(registers.value),
            frames * a_frame if frames.ndim == 1 else jnp.repeat(frames, a_frame, axis=1),
            implementation=self.implementation,
        )
        return camera_tokens + self.output(out.reshape(camera_tokens.shape))
