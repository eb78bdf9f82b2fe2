"""Global camera consistency refinement: camera tokens attend to the register tokens of the whole sequence."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.model.attention import attention
from logvggt_jax.model.layers import dense, layer_norm


class GCCR(nn.Module):
    """c' = c + O(Attn(Q(LN(c)), K(LN(R)), V(LN(R)))) (paper, equation of GCCR, with a residual).

    O starts at zero, so that a converted VGGT is unchanged.
    """

    num_heads: int
    dtype: str
    implementation: str

    @nn.compact
    def __call__(self, camera_tokens: jax.Array, register_tokens: jax.Array, register_mask: jax.Array) -> jax.Array:
        """[B, N, 2C], [B, M, 4, 2C], bool [B, M] (False: a frame whose registers do not count) -> [B, N, 2C]."""
        batch, _, width = camera_tokens.shape
        per_frame = register_tokens.shape[2]
        registers = register_tokens.reshape(batch, -1, width)
        queries = layer_norm(1e-5, "camera_norm")(camera_tokens)
        context = layer_norm(1e-5, "register_norm")(registers)

        def heads(tokens: jax.Array, name: str) -> jax.Array:
            projected = dense(width, name, self.dtype)(tokens).astype(self.dtype)
            return projected.reshape(*tokens.shape[:2], self.num_heads, width // self.num_heads)

        out = attention(
            heads(queries, "query"),
            heads(context, "key"),
            heads(context, "value"),
            jnp.repeat(register_mask, per_frame, axis=1),
            implementation=self.implementation,
        )
        update = dense(width, "output", self.dtype, kernel_init=nn.initializers.zeros_init())(
            out.reshape(camera_tokens.shape)
        )
        return camera_tokens + update.astype(jnp.float32)
