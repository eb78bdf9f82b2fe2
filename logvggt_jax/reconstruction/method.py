"""Which method suits a model's weights."""

from __future__ import annotations

import warnings

from logvggt_jax.streaming import METHODS
from logvggt_jax.weights.provenance import Provenance

# Of the methods that suit weights, the one that takes sequences of any length.
_PREFERRED = {"windows": "windows", "vggt": "chunks", "causal": "causal", None: "windows"}

# What to expect of weights that were trained for the first, in a method that wants them trained for the second.
_EXPECT: dict[tuple[str | None, str], str] = {
    ("vggt", "windows"): "these weights are public VGGT's, which never learned to pass the first camera on from window "
    "to window: cameras and depth of a sequence longer than one window will be wrong",
    ("vggt", "causal"): "these weights are public VGGT's, where every frame saw all others, and {method} shows a frame "
    "earlier ones alone: cameras and depth get worse from the first frame on",
    ("windows", "vggt"): "these weights were trained on windows with memory between them, and {method} shows them more "
    "frames at once than they have ever seen",
    ("windows", "causal"): "these weights were trained on windows with memory between them at the key layers, and "
    "{method} gives all layers a memory and frames one by one, as they have never seen it: expect worse cameras and "
    "depth",
    ("causal", "windows"): "these weights were trained to see all earlier frames in all layers, and never learned to "
    "pass the first camera on from window to window: cameras and depth of a sequence longer than one window will be "
    "wrong",
    ("causal", "vggt"): "these weights were trained on frames that see earlier ones alone, and {method} shows them "
    "later ones as well, as they have never seen it: expect worse cameras and depth",
}


def choose_method(provenance: Provenance, asked: str | None = None) -> str:
    """The method to reconstruct with: the one that was asked for, else the one that the weights were trained for.

    Warns, saying why, where weights and method do not belong together or the weights' training is not known.

    Args:
      provenance: of the weights.
      asked: a name of `METHODS`; None leaves the choice to the weights.
    """
    chosen = asked or _PREFERRED[provenance.trained_for]
    trained_for, wanted = provenance.trained_for, METHODS[chosen].trained_for
    if (trained_for, wanted) in _EXPECT:
        expect = _EXPECT[trained_for, wanted].format(method=chosen)
        warnings.warn(f"{expect}; leave --mode out for {_PREFERRED[trained_for]}", stacklevel=2)
    elif trained_for is None and asked is None:
        warnings.warn(
            "the model folder does not say what its weights were trained for, and windows are taken; if they are "
            "public VGGT's, pass --mode chunks, or convert them again",
            stacklevel=2,
        )
    return chosen
