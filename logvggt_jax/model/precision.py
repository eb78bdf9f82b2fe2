"""Float32 products that stay float32 on accelerators."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp


def product_precision(dtype: Any) -> jax.lax.Precision | None:
    """Precision of products of `dtype`: whole for float32, which TPUs would round to bfloat16 and GPUs to TF32."""
    return jax.lax.Precision.HIGHEST if jnp.dtype(dtype) == jnp.float32 else None
