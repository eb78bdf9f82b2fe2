"""Weights in and out: VGGT's checkpoints, this package's model folders."""

from logvggt_jax.weights.address import resolve
from logvggt_jax.weights.checkpoints import (
    convert,
    from_pretrained,
    load_model,
    read_provenance,
    save_model,
)
from logvggt_jax.weights.digests import digests, verify_digests
from logvggt_jax.weights.files import open_state_dict
from logvggt_jax.weights.provenance import Provenance
from logvggt_jax.weights.vggt import ConversionReport, config_from_vggt, parameter_shapes, params_from_vggt

__all__ = [
    "ConversionReport",
    "Provenance",
    "config_from_vggt",
    "convert",
    "digests",
    "from_pretrained",
    "load_model",
    "open_state_dict",
    "parameter_shapes",
    "params_from_vggt",
    "read_provenance",
    "resolve",
    "save_model",
    "verify_digests",
]
