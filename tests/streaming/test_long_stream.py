"""A long stream: the batch's numbers, and nothing on the device that grows but the tokens."""

from __future__ import annotations

import itertools

import jax
import numpy as np
import pytest

from logvggt_jax import LogVGGT
from logvggt_jax.streaming import StreamSession

FRAMES, CHUNK = 600, 256


def live_bytes() -> int:
    return sum(array.nbytes for array in jax.live_arrays())


@pytest.mark.slow
def test_long_stream(small_config, small_variables):
    model = LogVGGT(small_config)
    images = np.random.default_rng(0).integers(0, 256, (FRAMES, 28, 42, 3), dtype=np.uint8)
    session = StreamSession(model, small_variables, first_capacity=CHUNK)
    depth, held = [], {}
    for index, frame in enumerate(images):
        # Copies: on a CPU the results are views of device buffers, which live as long as somebody holds them.
        depth += [result.depth.copy() for result in session.push(frame)]
        held.setdefault(-(-(session.num_frames + 2) // CHUNK), set()).add(live_bytes()) if index > 4 else None
    depth += [result.depth for result in session.close()]

    # Between two growths of the token buffers, not a byte more is alive on the device.
    assert all(len(sizes) <= 2 for sizes in held.values()), held
    # Nothing else grows than what refinement reads: of a frame two camera tokens, and key and value of each register.
    tokens = 2 + 2 * small_config.aggregator.num_registers
    frame_bytes = tokens * 2 * small_config.encoder.embed_dim * 4
    levels = [max(held[chunk]) for chunk in sorted(held)]
    assert len(levels) == 3
    # Buffers double: room for 256, 512 and 1,024 frames.
    for growths, (before, after) in enumerate(itertools.pairwise(levels)):
        assert after - before <= 1.1 * 2**growths * CHUNK * frame_bytes

    whole = jax.jit(model.apply)(small_variables, images[None])
    np.testing.assert_allclose(np.stack(depth), whole.depth[0], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(session.cameras().extrinsics, whole.extrinsics[0], rtol=1e-3, atol=1e-3)
