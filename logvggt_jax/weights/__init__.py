"""Weights in and out: VGGT's checkpoints, this package's model folders."""

from logvggt_jax.weights.checkpoints import (
    convert,
    digests,
    from_pretrained,
    load_model,
    read_provenance,
    save_model,
    verify_digests,
)
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
    "save_model",
    "verify_digests",
]
