"""Square convolutions whose gradients stay fast inside loops on CPUs.

XLA's CPU compiler brings convolutions into the one form that it has a fast kernel for, but only outside of loops:
within the scan over windows a kernel's gradient falls back to scalar code, more than ten times slower. There the
gradients are written in forms that need no rewriting. Which form a program has is decided where it is lowered, so that
one for a described accelerator is that accelerator's.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.model.initializers import constant, fan_in_normal
from logvggt_jax.model.precision import product_precision
from logvggt_jax.model.shape_check import ShapeCheck


class Convolution(ShapeCheck, nn.Module):
    """[N, H, W, C] -> [N, ⌈H / strides⌉, ⌈W / strides⌉, features], `size` odd.

    Padding is explicit: "SAME" pads strided convolutions on one side only.
    """

    features: int
    size: int
    dtype: str
    strides: int = 1
    use_bias: bool = True

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        size, channels, dtype = self.size, x.shape[-1], jnp.dtype(self.dtype)
        kernel = self.param("kernel", fan_in_normal, (size, size, channels, self.features)).astype(dtype)
        x = x.astype(dtype)
        if size == 1:
            y = jnp.matmul(x, kernel[0, 0], precision=product_precision(dtype))
        elif self.strides == 1:
            y = _looped_convolution(x, kernel)
        else:
            y = _convolve(x, kernel, self.strides)
        if self.use_bias:
            y = y + self.param("bias", constant(0.0), (self.features,)).astype(dtype)
        return y


def _convolve(x: jax.Array, kernel: jax.Array, strides: int) -> jax.Array:
    margin = (kernel.shape[0] - 1) // 2
    return jax.lax.conv_general_dilated(
        x,
        kernel,
        (strides, strides),
        ((margin, margin), (margin, margin)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=product_precision(x.dtype),
    )


@jax.custom_vjp
def _looped_convolution(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Convolution of stride 1: [N, H, W, C], [k, k, C, F] -> [N, H, W, F]."""
    return _convolve(x, kernel, 1)


def _forward(x: jax.Array, kernel: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return _looped_convolution(x, kernel), (x, kernel)


def _backward(saved: tuple[jax.Array, jax.Array], gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jax.lax.platform_dependent(*saved, gradient, cpu=_by_products, default=_by_convolutions)


def _by_convolutions(x: jax.Array, kernel: jax.Array, gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    """As JAX differentiates a convolution, which is linear in each of the two."""
    (x_gradient,) = jax.linear_transpose(lambda x: _convolve(x, kernel, 1), x)(gradient)
    (kernel_gradient,) = jax.linear_transpose(lambda kernel: _convolve(x, kernel, 1), kernel)(gradient)
    return x_gradient, kernel_gradient


def _by_products(x: jax.Array, kernel: jax.Array, gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    """To the input: a convolution with the mirrored kernel. To the kernel: a product for each of its places."""
    size, (height, width) = kernel.shape[0], x.shape[1:3]
    x_gradient = _convolve(gradient, jnp.swapaxes(kernel[::-1, ::-1], 2, 3), 1)
    margin = (size - 1) // 2
    padded = jnp.pad(x, ((0, 0), (margin, margin), (margin, margin), (0, 0)))
    shifted = [padded[:, i : i + height, j : j + width] for i in range(size) for j in range(size)]
    kernel_gradient = jnp.einsum(
        "nhwc,nhwf->cf", jnp.concatenate(shifted, axis=-1), gradient, precision=product_precision(x.dtype)
    )
    return x_gradient, kernel_gradient.reshape(kernel.shape)


_looped_convolution.defvjp(_forward, _backward)
