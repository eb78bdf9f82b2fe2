"""What to expect of weights in a method that they were not trained for."""

from __future__ import annotations

from logvggt_jax.streaming.predictor import METHODS

# Of weights that were trained for the first, in a method that wants them trained for the second.
_EXPECT: dict[tuple[str | None, str], str] = {
    ("vggt", "windows"): "these weights are public VGGT's, which never learned to pass the first camera on from window "
    "to window: cameras and depth of a sequence longer than one window will be wrong",
    ("vggt", "causal"): "these weights are taken for public VGGT's (StreamVGGT's, whose files look the same, are known "
    "once converted with --trained-for causal), where every frame saw all others, and {method} shows a frame earlier "
    "ones alone: cameras and depth get worse from the first frame on",
    ("windows", "vggt"): "these weights were trained on windows with memory between them, and {method} shows them more "
    "frames at once than they have ever seen: expect worse cameras and depth",
    ("windows", "causal"): "these weights were trained on windows with memory between them at the key layers, and "
    "{method} gives all layers a memory and frames one by one, as they have never seen it: expect worse cameras and "
    "depth",
    ("causal", "windows"): "these weights were trained to see all earlier frames in all layers, and never learned to "
    "pass the first camera on from window to window: cameras and depth of a sequence longer than one window will be "
    "wrong",
    ("causal", "vggt"): "these weights were trained on frames that see earlier ones alone, and {method} shows them "
    "later ones as well, as they have never seen it: expect worse cameras and depth",
}


def expectation(trained_for: str | None, method: str) -> str | None:
    """What to expect, a clause without a full stop; None where weights and method suit each other, or it is not known.

    Args:
      trained_for: as `Provenance` has it.
      method: a name of `METHODS`.
    """
    expected = _EXPECT.get((trained_for, METHODS[method].trained_for))
    return None if expected is None else expected.format(method=method)
