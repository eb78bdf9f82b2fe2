"""Large products in eight bits, coded by qwix: int8, or fp8 (e4m3).

The kernels of the blocks of encoder and aggregator are coded once, with a scale for every output channel; the tokens
that meet them are coded at every call, with a scale for every token:

    x W ≈ (codes of x · codes of W) · scale of x · scale of W

Everything else stays as it is: norms, q/k norm and rotation, attention, patch embedding, GCCR, camera head and dense
heads. The functions of qwix are called where the products are: its providers, which replace `jax.lax.dot_general` while
a linen module runs, do not see into `parameters.run`, whose traces outlive them.
"""

from __future__ import annotations

import functools
import importlib
import re
from typing import Any

import jax
import jax.numpy as jnp

from logvggt_jax.errors import MissingPackage, install_line

PRECISIONS = {"int8": jnp.int8, "fp8": jnp.float8_e4m3fn}
_PARTS = ("encoder", "aggregator")
# Where eight bits are multiplied faster than sixteen: from which compute capability of CUDA on, and names of TPUs.
_FAST = {"int8": (7.5, "v[56]"), "fp8": (8.9, "7")}


def check_precision(precision: str) -> str | None:
    """A line where the device at hand is not known to multiply faster in this precision than in 16 bits; None where it
    is.

    Raises:
      MissingPackage: qwix is not installed.
    """
    _qwix()
    device, (capability, tpus) = jax.devices()[0], _FAST[precision]
    if device.platform == "gpu":
        number = re.fullmatch(r"\d+\.\d+", getattr(device, "compute_capability", ""))
        fast = number is None or float(number[0]) >= capability  # other makers' GPUs have no such number
    else:
        fast = device.platform == "tpu" and re.search(tpus, device.device_kind) is not None
    kind = device.device_kind
    return None if fast else f"{precision} products are not known to be faster than others on this device ({kind})"


def in_low_precision(variables: dict[str, Any], precision: str) -> dict[str, Any]:
    """Parameters {"params": …} in which each kernel [in, out] of the blocks is two arrays: its `codes` [in, out], and
    float32 `scale` [1, out]. `Dense` multiplies in eight bits where it is given these.

    Args:
      variables: float32 or 16 bits, the layers one by one or stacked.
      precision: one of `PRECISIONS`.

    Raises:
      MissingPackage: qwix is not installed.
    """
    _qwix()

    def coded(tree: Any) -> Any:
        if not isinstance(tree, dict):
            return tree
        if "kernel" not in tree:
            return {name: coded(inner) for name, inner in tree.items()}
        codes, scale = _coded(tree["kernel"], precision)
        return {"codes": codes, "scale": scale, **{name: x for name, x in tree.items() if name != "kernel"}}

    def blocks(part: dict[str, Any]) -> dict[str, Any]:
        return {name: coded(tree) if "block" in name else tree for name, tree in part.items()}

    params = variables["params"]
    return {"params": {part: blocks(tree) if part in _PARTS else tree for part, tree in params.items()}}


def product(tokens: jax.Array, codes: jax.Array, scale: jax.Array) -> jax.Array:
    """Tokens [..., in] of any floating type by a coded kernel, float32 [..., out]."""
    qwix = _qwix()
    last = tokens.ndim - 1
    # From float32: a quotient of 16 bits would be rounded twice.
    coded = qwix.quantize(tokens.astype(jnp.float32), codes.dtype, channelwise_axes=range(last))
    result: jax.Array = qwix.dot_general(coded, qwix.QArray(codes, scale), (((last,), (0,)), ((), ())))
    return result


def precision_of(variables: dict[str, Any]) -> str | None:
    """The one of `PRECISIONS` in which these parameters are coded; None where they are not."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(variables):
        if path[-1].key == "codes":
            return next(name for name, dtype in PRECISIONS.items() if leaf.dtype == dtype)
    return None


@functools.partial(jax.jit, static_argnums=1)
def _coded(kernel: jax.Array, precision: str) -> tuple[jax.Array, jax.Array]:
    channels = [axis for axis in range(kernel.ndim) if axis != kernel.ndim - 2]
    coded = _qwix().quantize(kernel.astype(jnp.float32), PRECISIONS[precision], channelwise_axes=channels)
    return coded.qvalue, coded.scale


def _qwix() -> Any:
    try:
        return importlib.import_module("qwix")
    except ImportError as error:
        line = install_line("lowprecision")
        raise MissingPackage(f"products in eight bits need qwix, which is not installed: {line}") from error
