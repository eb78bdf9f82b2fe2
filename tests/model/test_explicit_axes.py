"""A mesh whose axes are explicit in types: the model takes batches that are split over it."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import NamedSharding, P
from jax.sharding import AxisType

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.model.initializers import constant


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


def test_parameters_that_are_split_are_not_taken_for_the_batch(
    small_config: ModelConfig, small_variables: dict
) -> None:
    model = LogVGGT(small_config)
    mesh = jax.make_mesh((2, 2), ("data", "parts"), axis_types=(AxisType.Explicit, AxisType.Explicit))

    def split(leaf: np.ndarray) -> jax.Array:
        kernel = leaf.ndim == 2 and leaf.shape[0] % 2 == 0
        return jax.device_put(leaf, NamedSharding(mesh, P("parts") if kernel else P()))

    parts = jax.tree.map(split, small_variables)
    frames, width = 4, 2 * small_config.encoder.embed_dim
    generator = np.random.default_rng(0)
    for batch, spec in ((2, P("data")), (1, P())):
        tokens = generator.standard_normal((batch, frames, 5, width)).astype(np.float32)
        given = [jax.device_put(array, NamedSharding(mesh, spec)) for array in (tokens[:, :, 0], tokens[:, :, 1:])]
        mask = jax.device_put(np.ones((batch, frames), bool), NamedSharding(mesh, spec))
        named = dict(zip(("camera_tokens", "register_tokens"), given, strict=True))
        refine = jax.jit(model.refine)
        found = refine(parts, *given, mask, mask)
        by_name = refine(variables=parts, **named, camera_mask=mask, register_mask=mask)
        np.testing.assert_allclose(by_name, found, rtol=1e-5, atol=1e-6)
        assert tuple(found.sharding.spec)[:1] == (tuple(spec) or (None,))
        everyone = np.ones((batch, frames), bool)
        expected = model.refine(small_variables, tokens[:, :, 0], tokens[:, :, 1:], everyone, everyone)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_initial_values_lie_where_a_mesh_that_is_set_puts_them() -> None:
    """Also those that are made while what is around them is only traced, as parameters are."""
    made = []

    def trace() -> None:
        with jax.ensure_compile_time_eval():
            made.append(constant(0.5)(jax.random.key(0), (2, 3)))

    with jax.set_mesh(jax.make_mesh((2,), ("data",), axis_types=(AxisType.Explicit,))):
        trace()
        jax.eval_shape(trace)
        others = jnp.asarray(np.zeros((2, 3), np.float32)).sharding
    assert [value.sharding for value in made] == [others, others]
    trace()
    assert made[-1].sharding == jnp.zeros((2, 3)).sharding
