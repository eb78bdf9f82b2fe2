"""Which method suits a model's weights."""

from __future__ import annotations

import warnings

from logvggt_jax.streaming import expectation
from logvggt_jax.weights.provenance import Provenance

# Of the methods that suit weights, the one that takes sequences of any length.
_PREFERRED = {"windows": "windows", "vggt": "chunks", "causal": "causal", None: "windows"}


def choose_method(provenance: Provenance, asked: str | None = None) -> str:
    """The method to reconstruct with: the one that was asked for, else the one that the weights were trained for.

    Warns, saying why, where weights and method do not belong together or the weights' training is not known.

    Args:
      provenance: of the weights.
      asked: a name of `METHODS`; None leaves the choice to the weights.
    """
    chosen = asked or _PREFERRED[provenance.trained_for]
    trained_for = provenance.trained_for
    if expect := expectation(trained_for, chosen):
        warnings.warn(f"{expect}; leave --method out for {_PREFERRED[trained_for]}", stacklevel=2)
    elif trained_for is None and asked is None:
        warnings.warn(
            "the model folder does not say what its weights were trained for, and windows are taken; if they are "
            "public VGGT's, pass --method chunks, or convert them again",
            stacklevel=2,
        )
    return chosen
