"""Which method suits a model's weights."""

from __future__ import annotations

import warnings

from logvggt_jax.weights.provenance import Provenance

_FITTING = {"windows": "windows", "vggt": "chunks", None: "windows"}


def choose_method(provenance: Provenance, asked: str | None = None) -> str:
    """The method to reconstruct with: the one that was asked for, else the one that the weights were trained for.

    Warns, saying why, where weights and method do not belong together or the weights' training is not known.

    Args:
      provenance: of the weights.
      asked: a method's name; None leaves the choice to the weights.
    """
    fitting = _FITTING[provenance.trained_for]
    if provenance.trained_for is None and asked is None:
        warnings.warn(
            "the model folder does not say what its weights were trained for, and windows are taken; if they are "
            "public VGGT's, pass --mode chunks, or convert them again",
            stacklevel=2,
        )
    elif provenance.trained_for == "vggt" and asked == "windows":
        warnings.warn(
            "these weights are public VGGT's, which never learned to pass the first camera on from window to window: "
            "cameras and depth of a sequence longer than one window will be wrong; leave --mode out for chunks",
            stacklevel=2,
        )
    elif provenance.trained_for == "windows" and asked not in (None, fitting):
        warnings.warn(
            f"these weights were trained on windows with memory between them, and {asked} shows them more frames at "
            "once than they have ever seen; leave --mode out for windows",
            stacklevel=2,
        )
    return asked or fitting
