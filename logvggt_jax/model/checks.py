"""What the model's functions may be given: shapes and dtypes, checked before anything is traced."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

# What rounding may take values of floating point beyond [0, 1].
_SLACK = 1e-2


def check_array(name: str, array: jax.Array, shape: tuple[int | None, ...], kind: Any) -> None:
    """Raises ValueError unless an array has this shape (None: any size) and its dtype is of this kind."""
    found = _shape(name, array)
    fits = len(found) == len(shape) and all(a in (b, None) for a, b in zip(shape, found, strict=True))
    if not fits or not jnp.issubdtype(array.dtype, kind):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        kind_name = "bool" if kind is jnp.bool_ else "floating point"
        raise ValueError(f"{name} must be {kind_name} [{wanted}], got {array.dtype} {list(found)}")


def check_images(images: jax.Array, patch_size: int, name: str = "images") -> None:
    """Raises ValueError unless images are [B, T, H, W, 3], uint8 or floating point, H and W multiples of a patch."""
    shape = _shape(name, images)
    if len(shape) != 5 or shape[-1] != 3 or 0 in shape:
        raise ValueError(f"{name} must have shape [B, T, H, W, 3] with T >= 1, got {shape}")
    check_pixels(images, patch_size, name)


def check_pixels(images: Any, patch_size: int, name: str) -> None:
    """Raises ValueError unless images [..., H, W, 3] are uint8 or floating point, H and W multiples of a patch.

    Outside of `jit` values of floating point are looked at, too: they must lie in [0, 1].
    """
    height, width = images.shape[-3:-1]
    if height % patch_size or width % patch_size:
        raise ValueError(
            f"{name} have height {height} and width {width}, which must be multiples of {patch_size}; "
            "logvggt_jax.preprocess resizes frames of any size"
        )
    if images.dtype != jnp.uint8 and not jnp.issubdtype(images.dtype, jnp.floating):
        raise ValueError(f"{name} must be uint8 or floating point in [0, 1], got dtype {images.dtype}")
    if images.dtype != jnp.uint8 and not isinstance(images, jax.core.Tracer | jax.ShapeDtypeStruct):
        with jax.ensure_compile_time_eval():  # also where a function that is traced closes over them
            wrong = _wrong_values(images)
        if wrong is not None:
            raise ValueError(f"{name} must be floating point in [0, 1], got {wrong}")


def check_masks(images: jax.Array, masks: jax.Array | None) -> None:
    """Raises ValueError unless masks are None, or bool [B, T, H, W] for images [B, T, H, W, 3]."""
    if masks is not None:
        check_array("masks", masks, images.shape[:4], jnp.bool_)


def checked_mask(images: jax.Array, mask: jax.Array | None) -> jax.Array:
    """The frame mask bool [B, T] of images [B, T, …]: all frames where None is given."""
    if mask is None:
        return jnp.ones(images.shape[:2], bool)
    check_array("frame_mask", mask, images.shape[:2], jnp.bool_)
    return jnp.asarray(mask)


def _shape(name: str, array: Any) -> tuple[int, ...]:
    if not hasattr(array, "shape"):
        raise ValueError(f"{name} must be an array, got {type(array).__name__}")
    return tuple(array.shape)


def _wrong_values(images: Any) -> str | None:
    """What there is beyond [0, 1] in images of floating point, and how to mend it; None for none."""
    # Pixel by pixel: where one is NaN, the smallest and largest value may on a CPU be those of the others.
    if ((images >= -_SLACK) & (images <= 1 + _SLACK)).all():
        return None
    if jnp.isnan(images).any():
        return "values from nan to nan; no pixel may be NaN"
    low, high = float(images.min()), float(images.max())
    return f"values from {low:g} to {high:g}; divide those of 0 to 255 by 255, or give uint8"
