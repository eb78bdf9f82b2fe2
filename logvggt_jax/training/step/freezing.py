"""Parameters that do not move, chosen by patterns of their names.

A name is the path in the tree that is trained, in which deep stacks are one: `encoder/blocks/mlp/fc1/kernel`,
`aggregator/global_blocks/attention/query/kernel`, `camera_head/trunk/norm1/scale`. Patterns have the wildcards of
`fnmatch`, where `*` stands for slashes too: `encoder/*` is the whole encoder.
"""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any

import jax

from logvggt_jax.errors import InputError
from logvggt_jax.training.config import TrainConfig

ENCODER = "encoder/*"


def frozen_patterns(config: TrainConfig) -> tuple[str, ...]:
    """The patterns of a run: those that are asked for, and the encoder's where the model holds it still."""
    return (*((ENCODER,) if config.model.encoder.frozen else ()), *config.optimizer.frozen)


def frozen_leaves(params: Any, patterns: Sequence[str]) -> Any:
    """Of every leaf of a tree of parameters, or of shapes: whether one of `patterns` matches its name.

    Raises InputError for a pattern that matches none, and where nothing is left to be trained.
    """
    names = [_name(path) for path, _ in jax.tree_util.tree_leaves_with_path(params)]
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise InputError(
                f"optimizer.frozen: no parameter matches {pattern!r}; names are such as "
                f"{', '.join(names[:: len(names) // 3 + 1])}, and encoder/* stands for a whole module"
            )
    if all(_matches(name, patterns) for name in names):
        raise InputError(f"optimizer.frozen={tuple(patterns)} leaves nothing to be trained: freeze less")
    return jax.tree_util.tree_map_with_path(lambda path, _: _matches(_name(path), patterns), params)


def without_gradient(params: Any, patterns: Sequence[str]) -> Any:
    """The same values, which give no gradient to what `patterns` freeze: none is computed, nothing is kept for it."""

    def stopped(path: Any, leaf: jax.Array) -> jax.Array:
        return jax.lax.stop_gradient(leaf) if _matches(_name(path), patterns) else leaf

    return jax.tree_util.tree_map_with_path(stopped, params) if patterns else params


def _name(path: Any) -> str:
    # A parameter that lies in parts has its value one step deeper.
    return "/".join(str(entry.key) for entry in path if isinstance(entry, jax.tree_util.DictKey))


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)
