"""When GCCR runs and which frames the camera head sees: full sequence, periodic, online, limited context.

Shared by `LogVGGT.apply`, which loops over triggers, and by streams, which fire them one by one.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

RefineTokens = Callable[[jax.Array, jax.Array], jax.Array]
DecodeCameras = Callable[[jax.Array, jax.Array], jax.Array]


def num_triggers(num_frames: int, period: int | None) -> int:
    """How often GCCR runs over `num_frames` frames: once without a period, else every `period` frames."""
    return 1 if period is None else -(-num_frames // period)


def trigger_range(trigger: int, num_frames: int, period: int | None) -> tuple[int, int]:
    """Frames [start, stop) that a trigger (from 0) refines; they see the registers of frames [0, stop)."""
    if period is None:
        return 0, num_frames
    return trigger * period, min((trigger + 1) * period, num_frames)


def decode_group(
    decode_cameras: DecodeCameras,
    refined_tokens: jax.Array,
    lengths: jax.Array,
    start: jax.Array | int,
    stop: jax.Array | int,
    *,
    group: int,
    context: int,
) -> jax.Array:
    """Pose encodings [B, group, R, 9] of frames start … start + group − 1, seen with a limited context.

    The trunk sees frame 0 and the `context` frames up to `stop` (the group's end, or the item's own if that
    comes first); entries at or beyond `stop` mean nothing.

    Args:
      decode_cameras: camera head, ([B, n, 2C], bool [B, n]) -> [B, n, R, 9].
      refined_tokens: [B, N, 2C].
      lengths: int [B], the items' numbers of frames.
      start: first frame of the group.
      stop: frame after the group's last, start < stop <= start + group.
      group: frames of a group, the window stride.
      context: at least `group`.
    """
    ends = jnp.minimum(stop, lengths)[:, None]
    frames = ends - context + jnp.arange(context)
    recent = jnp.take_along_axis(refined_tokens, jnp.maximum(frames, 0)[..., None], axis=1)
    tokens = jnp.concatenate([refined_tokens[:, :1], recent], axis=1)
    # Frame 0 has a slot of its own only where the recent frames do not include it.
    valid = jnp.concatenate([ends > context, frames >= 0], axis=1)
    encodings = decode_cameras(tokens, valid)
    slots = jnp.clip(start + jnp.arange(group) - ends + context + 1, 0, context)
    return jnp.take_along_axis(encodings, slots[..., None, None], axis=1)


def refine_sequence(
    refine_tokens: RefineTokens,
    decode_cameras: DecodeCameras,
    camera_tokens: jax.Array,
    frame_mask: jax.Array,
    *,
    period: int | None,
    context: int | None,
    group: int,
) -> jax.Array:
    """Pose encodings [B, T, R, 9] of a whole sequence, whatever the mode.

    Args:
      refine_tokens: GCCR over the sequence's registers, ([B, n, 2C], bool [B, T] frames whose registers count) ->
        [B, n, 2C].
      decode_cameras: camera head, ([B, n, 2C], bool [B, n]) -> [B, n, R, 9].
      camera_tokens: [B, T, 2C].
      frame_mask: bool [B, T], True … True False … False.
      period: frames between triggers, None for one at the end.
      context: frames that the trunk sees beside frame 0, None for all so far.
      group: frames decoded together under a limited context (the window stride).
    """
    num_frames = camera_tokens.shape[1]
    step = num_frames if period is None else min(period, num_frames)
    if step == num_frames and context is None:
        refined = refine_tokens(camera_tokens, frame_mask)
        return decode_cameras(refined, frame_mask)

    triggers = num_triggers(num_frames, step)
    lengths = frame_mask.sum(1)
    # Room for the last trigger's and the last group's full size: slices keep one shape.
    padding = triggers * step + group - num_frames
    tokens = jnp.pad(camera_tokens, ((0, 0), (0, padding), (0, 0)))
    mask = jnp.pad(frame_mask, ((0, 0), (0, padding)))
    order = jnp.arange(tokens.shape[1])
    shapes = jax.eval_shape(decode_cameras, tokens[:, :1], mask[:, :1])
    encodings = jnp.zeros_like(tokens, shape=(*tokens.shape[:2], *shapes.shape[2:]))

    def one_trigger(carry: tuple[jax.Array, jax.Array], trigger: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
        refined, encodings = carry
        start = trigger * step
        stop = jnp.minimum(start + step, num_frames)
        fresh = jax.lax.dynamic_slice_in_dim(tokens, start, step, axis=1)
        fresh = refine_tokens(fresh, frame_mask & (order[:num_frames] < stop))
        refined = jax.lax.dynamic_update_slice_in_dim(refined, fresh, start, axis=1)
        if context is None:
            decoded = decode_cameras(refined, mask & (order < stop))
            decoded = jax.lax.dynamic_slice_in_dim(decoded, start, step, axis=1)
            return (refined, jax.lax.dynamic_update_slice_in_dim(encodings, decoded, start, axis=1)), None

        def one_group(encodings: jax.Array, first: jax.Array) -> tuple[jax.Array, None]:
            last = jnp.minimum(first + group, stop)
            decoded = decode_group(decode_cameras, refined, lengths, first, last, group=group, context=context)
            return jax.lax.dynamic_update_slice_in_dim(encodings, decoded, first, axis=1), None

        firsts = start + group * jnp.arange(-(-step // group))
        return (refined, jax.lax.scan(one_group, encodings, firsts)[0]), None

    (_, encodings), _ = jax.lax.scan(one_trigger, (tokens, encodings), jnp.arange(triggers))
    return encodings[:, :num_frames]
