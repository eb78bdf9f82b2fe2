"""Iterative camera head: camera tokens of all frames to pose encodings, four rounds of correction."""

from __future__ import annotations

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.config import CameraHeadConfig
from logvggt_jax.model.initializers import constant
from logvggt_jax.model.layers import MLP, Block, dense, layer_norm
from logvggt_jax.model.memory import Memory, RoundMemory
from logvggt_jax.model.parameters import run
from logvggt_jax.model.shape_check import ShapeCheck


class CameraHead(ShapeCheck, nn.Module):
    """Poses of a sequence from its camera tokens, in rounds that correct one another.

    A round embeds the pose of the round before, which shifts, scales and gates the tokens (adaptive LayerNorm), runs
    the trunk over them, and adds what comes out to the pose.

    Float32 throughout, since rotations lose orthogonality in bfloat16.
    """

    config: CameraHeadConfig
    implementation: str

    @nn.compact
    def __call__(
        self, camera_tokens: jax.Array, camera_mask: jax.Array | None, memory: RoundMemory | None = None
    ) -> tuple[jax.Array, RoundMemory]:
        """Pose encodings [B, N, R, 9] after each of the R rounds, of which the last counts; and the memory it leaves.

        In the trunk every frame sees all frames that count, and what the memory adds. No gradient flows from a round
        into the pose of the round before. In the result a negative field of view is 0; the next round is given it as it
        is.

        Args:
          camera_tokens: [B, N, 2C].
          camera_mask: which frames count: bool [B, N], or int32 [B] for the first so many; None for all.
          memory: of the trunk; None for frames that see one another and nothing else.
        """
        config, memory = self.config, memory or RoundMemory()
        width = camera_tokens.shape[-1]
        tokens = layer_norm(1e-5, "token_norm")(camera_tokens.astype(jnp.float32))
        empty = self.param("empty_pose_tokens", constant(0.0), (1, 1, 9))
        plain = layer_norm(1e-6, "adaptive_norm", affine=False)(tokens)

        stack = self.get_variable("params", "trunk") if self.has_variable("params", "trunk") else None

        def block(**options: Any) -> Block:
            return Block(
                config.num_heads,
                4,
                epsilon=1e-5,
                layer_scale=config.layer_scale,
                implementation=self.implementation,
                **options,
            )

        def one_of_stack(z: jax.Array, params: Any) -> tuple[jax.Array, None]:
            return run(block(parent=None), params, z, valid=camera_mask)[0], None

        def one_round(
            module: CameraHead, carry: tuple[jax.Array, jax.Array, Memory | None], own: Memory | None
        ) -> tuple[tuple[jax.Array, jax.Array, Memory | None], tuple[jax.Array, Memory | None]]:
            del module  # the submodules below attach to this module's scope by themselves
            embedded, pose, shared = carry
            seen = shared if own is None else own
            features = jax.nn.silu(dense(width, "embed_pose")(embedded))
            shift, scale, gate = jnp.split(dense(3 * width, "modulation")(features), 3, axis=-1)
            z = gate * (plain * (1.0 + scale) + shift) + tokens
            if stack is not None and seen is None:
                z, _ = jax.lax.scan(one_of_stack, z, stack)
            else:
                for i in range(config.depth):
                    if stack is None:
                        one_block: Any = block(name=f"trunk_{i}")
                    else:
                        one_block = functools.partial(run, block(parent=None), jax.tree.map(lambda x, i=i: x[i], stack))
                    z, left = one_block(z, valid=camera_mask, memory=None if seen is None else seen.at(i))
                    if seen is not None and left is not None:
                        seen = seen.updated(i, left)
            z = layer_norm(1e-5, "trunk_norm")(z)
            pose = jax.lax.stop_gradient(pose) + MLP(width // 2, 9, "float32", name="pose_branch")(z)
            emitted = jnp.concatenate([pose[..., :7], jax.nn.relu(pose[..., 7:])], axis=-1)
            own, shared = (own, seen) if own is None else (seen, shared)
            return (jax.lax.stop_gradient(pose), pose, shared), (emitted, own)

        shape = (*tokens.shape[:2], 9)
        first = jnp.broadcast_to(empty, shape)
        initial = jnp.broadcast_to(jnp.asarray(config.initial_pose, jnp.float32), shape)
        if not self.is_initializing():
            # For a backward pass a round keeps what enters it and is run again, which is cheap.
            one_round = nn.remat(one_round, prevent_cse=False)
        rounds = nn.scan(one_round, variable_broadcast="params", split_rngs={"params": False}, length=config.iterations)
        (_, _, shared), (encodings, each) = rounds(self, (first, initial, memory.shared), memory.each)
        return jnp.moveaxis(encodings, 0, 2), RoundMemory(each, shared)
