"""Iterative camera head: camera tokens of all frames to pose encodings, four rounds of correction."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.config import CameraHeadConfig
from logvggt_jax.model.initializers import constant
from logvggt_jax.model.layers import MLP, Block, dense, layer_norm


class CameraHead(nn.Module):
    """Float32 throughout: rotations lose orthogonality in bfloat16."""

    config: CameraHeadConfig
    implementation: str

    @nn.compact
    def __call__(self, camera_tokens: jax.Array, camera_mask: jax.Array) -> jax.Array:
        """Pose encodings [B, N, R, 9] of all rounds, the last one best.

        Args:
          camera_tokens: [B, N, 2C].
          camera_mask: which of them count, bool [B, N] or the first so many, int32 [B].

        Frames see one another in the trunk; those that do not count are seen by none. Raw encodings accumulate
        over rounds without gradient through the feedback; the field of view is clipped at zero on the way out
        only.
        """
        config = self.config
        width = camera_tokens.shape[-1]
        tokens = layer_norm(1e-5, "token_norm")(camera_tokens.astype(jnp.float32))
        empty = self.param("empty_pose_tokens", constant(0.0), (1, 1, 9))
        plain = layer_norm(1e-6, "adaptive_norm", affine=False)(tokens)

        def one_round(
            module: CameraHead, carry: tuple[jax.Array, jax.Array], nothing: None
        ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
            del module, nothing  # the submodules below attach to this module's scope by themselves
            embedded, pose = carry
            features = jax.nn.silu(dense(width, "embed_pose")(embedded))
            shift, scale, gate = jnp.split(dense(3 * width, "modulation")(features), 3, axis=-1)
            z = gate * (plain * (1.0 + scale) + shift) + tokens
            for i in range(config.depth):
                z, _ = Block(
                    config.num_heads,
                    4,
                    epsilon=1e-5,
                    layer_scale=config.layer_scale,
                    implementation=self.implementation,
                    name=f"trunk_{i}",
                )(z, valid=camera_mask)
            z = layer_norm(1e-5, "trunk_norm")(z)
            pose = jax.lax.stop_gradient(pose) + MLP(width // 2, 9, "float32", name="pose_branch")(z)
            emitted = jnp.concatenate([pose[..., :7], jax.nn.relu(pose[..., 7:])], axis=-1)
            return (jax.lax.stop_gradient(pose), pose), emitted

        shape = (*tokens.shape[:2], 9)
        first = jnp.broadcast_to(empty, shape)
        initial = jnp.broadcast_to(jnp.asarray(config.initial_pose, jnp.float32), shape)
        rounds = nn.scan(one_round, variable_broadcast="params", split_rngs={"params": False}, length=config.iterations)
        _, encodings = rounds(self, (first, initial), None)
        return jnp.moveaxis(encodings, 0, 2)
