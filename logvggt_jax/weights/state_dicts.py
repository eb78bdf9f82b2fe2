"""Which of a checkpoint's mappings holds the model, and its names without what wrappers put before them."""

import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from logvggt_jax.errors import InputError

# How deep a model is looked for: {"checkpoint": {"state_dict": {"model": …}}}.
_DEPTH = 3
_USUAL_KEYS = ("model", "state_dict", "model_state_dict", "module", "net", "network", "weights", "params")
_AVERAGED = re.compile(r"(?:^|[_.])ema(?:[_.]|$)|shadow|averag|teacher", re.IGNORECASE)
# The model's parts, before which wrappers write names of their own.
_PART = re.compile(r"(?:^|\.)(?P<part>(?:aggregator|camera_head|depth_head|point_head|track_head)\.)")
# Of DataParallel, trainers and Lightning; of torch.compile and sharding, which also wrap parts of a model.
_PREFIXES = ("module.", "model.", "net.", "network.", "vggt.", "backbone.")
_WRAPPED = re.compile(r"(?:^|(?<=\.))(?:_orig_mod|_fsdp_wrapped_module|_checkpoint_wrapped_module)\.")
# A prefix counts if at least this share of the names carries it.
_NEARLY_ALL = 0.9


def find_state_dict(
    tree: Mapping[Any, Any], is_tensor: Callable[[Any], bool], where: str
) -> tuple[Mapping[Any, Any], str | None]:
    """The mapping of a checkpoint that holds the model's tensors: itself, or one inside of it; and what is beside it.

    Of several of about the same size, a model and its moving average, the model is taken, with a warning. The text is
    None where the tree itself is the mapping. Raises InputError listing the entries where there is none; `where` is the
    file's path.
    """
    found = [(path, node, count) for path, node, count in _mappings(tree, is_tensor) if count]
    if not found:
        raise InputError(
            f"{where}: holds no tensors by name; its entries: {described(tree)}; expected a state dict, or one "
            f"under {', '.join(map(repr, _USUAL_KEYS[:3]))}, as torch.save(model.state_dict(), path) writes it"
        )
    largest = max(count for *_, count in found)
    rivals = [(path, node) for path, node, count in found if 2 * count >= largest]
    path, node = min(rivals, key=lambda rival: _rank(rival[0]))
    if len(rivals) > 1:
        names = ", ".join(_shown(path) for path, _ in rivals)
        warnings.warn(f"{where}: holds several state dicts, {names}; {_shown(path)} is read", stacklevel=2)
    return node, None if not path else f"{_shown(path)} of the entries {described(tree)}"


def described(tree: Mapping[Any, Any], most: int = 12) -> str:
    """The entries of a mapping with what they are: `model (2 entries), epoch (int)`."""
    texts = []
    for key, value in list(tree.items())[:most]:
        kind = f"{len(value)} entries" if isinstance(value, dict) else str(getattr(value, "kind", type(value).__name__))
        texts.append(f"{key!s:.60} ({kind:.80})")
    return (", ".join(texts) or "none") + (f" and {len(tree) - most} more" if len(tree) > most else "")


def plain_names(names: Sequence[str], where: str) -> dict[str, str]:
    """The names of a state dict without the prefixes that nearly all of them carry, to the names in the file.

    Of a model and its moving average, told apart by their prefixes, the model is taken, with a warning. What lacks the
    prefix stays if its first part is one of the model's (`aggregator`); the rest, a wrapper's own, is left out with a
    warning. Raises InputError where two names become one; `where` is the file's path.
    """
    plain = _of_one_model([(_WRAPPED.sub("", name), name) for name in names], where)
    outside: list[str] = []
    while prefix := _common_prefix([name for name, _ in plain]):
        parts = {name.removeprefix(prefix).split(".")[0] for name, _ in plain if name.startswith(prefix)}
        kept = [pair for pair in plain if pair[0].startswith(prefix) or pair[0].split(".")[0] in parts]
        outside += [original for name, original in plain if (name, original) not in set(kept)]
        plain = [(name.removeprefix(prefix), original) for name, original in kept]
    if outside:
        warnings.warn(
            f"{where}: {len(outside)} tensors outside of the model are left out, first {', '.join(outside[:3])}",
            stacklevel=2,
        )
    result: dict[str, str] = {}
    for name, original in plain:
        if name in result:
            raise InputError(f"{where}: {result[name]} and {original} are the same parameter {name}; give one of them")
        result[name] = original
    return result


def _mappings(
    tree: Mapping[Any, Any], is_tensor: Callable[[Any], bool]
) -> Iterator[tuple[tuple[str, ...], Mapping[Any, Any], int]]:
    """Every mapping down to `_DEPTH` with its path and how many tensors it holds by name; none of an optimizer."""
    seen, level = {id(tree)}, [((), tree)]
    for _ in range(_DEPTH + 1):
        below: list[tuple[Any, Any]] = []
        for path, node in level:
            yield path, node, sum(isinstance(key, str) and is_tensor(value) for key, value in node.items())
            for key, value in node.items():
                if isinstance(key, str) and isinstance(value, dict) and "optim" not in key and id(value) not in seen:
                    seen.add(id(value))
                    below.append(((*path, key), value))
        level = below


def _rank(path: tuple[str, ...]) -> tuple[bool, int, int]:
    usual = [_USUAL_KEYS.index(key) if key in _USUAL_KEYS else len(_USUAL_KEYS) for key in path]
    return any(_AVERAGED.search(key) for key in path), len(path), sum(usual)


def _shown(path: tuple[str, ...]) -> str:
    return repr(".".join(path)) if path else "the outermost"


def _of_one_model(pairs: list[tuple[str, str]], where: str) -> list[tuple[str, str]]:
    """Of pairs of a name and that in the file, those of one model where the names before its parts tell several."""
    counts = Counter(_before_parts(name) for name, _ in pairs)
    del counts[None]
    largest = max(counts.values(), default=0)
    rivals = [prefix for prefix, count in counts.items() if prefix is not None and 2 * count >= largest]
    if len(rivals) < 2:
        return pairs
    chosen = min(rivals, key=lambda prefix: (_AVERAGED.search(prefix) is not None, len(prefix)))
    shown = ", ".join(repr(prefix) for prefix in rivals)
    warnings.warn(f"{where}: holds several models, named {shown}; {chosen!r} is read", stacklevel=3)
    return [pair for pair in pairs if _before_parts(pair[0]) in (chosen, None)]


def _before_parts(name: str) -> str | None:
    """What stands before the first part of the model in a name; None where there is no part."""
    match = _PART.search(name)
    return None if match is None else name[: match.start("part")]


def _common_prefix(names: Sequence[str]) -> str | None:
    own = dict.fromkeys(before for name in names if (before := _before_parts(name)))
    for prefix in (*_PREFIXES, *own):
        if names and sum(name.startswith(prefix) for name in names) >= _NEARLY_ALL * len(names):
            return prefix
    return None
