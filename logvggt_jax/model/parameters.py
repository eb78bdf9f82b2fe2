"""Parameters of the parts, {"params": {part: …}}, and the parts as pure functions of their own."""

from __future__ import annotations

from typing import Any

import flax.linen as nn

Variables = dict[str, Any]


def run(module: nn.Module, params: Any, *inputs: Any, **options: Any) -> Any:
    """A linen module as a pure function of its own parameters."""
    return module.apply({"params": params}, *inputs, **options)
