"""A mesh whose axes are explicit in types: the model takes batches that are split over it."""

import jax
import numpy as np
from jax import NamedSharding, P
from jax.sharding import AxisType

from logvggt_jax import LogVGGT, ModelConfig


def test_a_batch_over_explicit_axes_gives_its_numbers_split_as_it_was(
    small_config: ModelConfig, small_variables: dict
) -> None:
    model = LogVGGT(small_config)
    shape = (2, model.windows.overlap, 28, 42, 3)
    images = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    mesh = jax.make_mesh((2,), ("data",), axis_types=(AxisType.Explicit,))
    split = jax.device_put(images, NamedSharding(mesh, P("data")))
    everywhere = jax.device_put(small_variables, NamedSharding(mesh, P()))
    mask = np.ones(shape[:2], bool)
    start = jax.jit(model.start)
    found, expected = start(everywhere, split, frame_mask=mask), start(small_variables, images, frame_mask=mask)
    assert found.patch_tokens.sharding.spec[0] == "data" and len(found.patch_tokens.sharding.device_set) == 2
    np.testing.assert_allclose(found.patch_tokens, expected.patch_tokens, rtol=1e-5, atol=1e-5)
