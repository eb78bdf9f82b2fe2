"""Data sources as the command line has them: `seven_scenes=/data/7scenes,frames=:700,stride=1:4`."""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from logvggt_jax.errors import InputError

_FORM = "NAME=FOLDER, then any of ,split=SPLIT ,frames=FIRST:STOP ,stride=LEAST:MOST ,weight=NUMBER"
_NOTHING = "none"
_FIELDS = re.compile(r"(.*?)((?:,(?:split|frames|stride|weight)=[^,]*)*)", re.DOTALL)


def with_sources(settings: Mapping[str, Any], trained: Sequence[str], validated: Sequence[str]) -> dict[str, Any]:
    """The settings of a run with other sources, as `parse_source` reads them, to train and to validate on.

    No texts leave what is there; with `none` in the place of the latter the run has no validation. Raises InputError as
    `parse_source`, for a run without validation, and for `none` beside others.
    """
    changed = dict(settings)
    if trained:
        changed["data"] = {**settings.get("data", {}), "sources": [parse_source(text) for text in trained]}
    if _NOTHING in validated:
        if len(validated) > 1:
            raise InputError("--validation_source is none and something: give one of them")
        changed["validation"] = None
    elif validated:
        if settings.get("validation") is None:
            raise InputError("--validation_source: this configuration validates nothing")
        changed["validation"] = {**settings["validation"], "sources": [parse_source(text) for text in validated]}
    return changed


def parse_source(text: str) -> dict[str, Any]:
    """The fields of a `SourceConfig` from `NAME=FOLDER,split=…,frames=FIRST:STOP,stride=LEAST:MOST,weight=…`.

    All but name and folder may be left out; the split is then `all`. Of `frames` either end may be left out or count
    from the end, as in a slice. An empty folder is none (`rooms=`). Raises InputError for another form.
    """
    name, given, rest = text.partition("=")
    match = _FIELDS.fullmatch(rest)
    if not (name and given and match):
        raise InputError(f"a source is {_FORM}; got {text!r}")
    source: dict[str, Any] = {"name": name, "root": match[1] or None, "split": "all"}
    for field in filter(None, match[2].split(",")):
        key, _, value = field.partition("=")
        try:
            source[key] = _READ[key](value)
        except ValueError:
            raise InputError(f"{field!r} in {text!r}: a source is {_FORM}") from None
    return source


def _pair(text: str) -> tuple[int | None, int | None]:
    first, colon, last = text.partition(":")
    if not colon:
        raise ValueError(text)
    return int(first) if first else None, int(last) if last else None


_READ: dict[str, Callable[[str], Any]] = {"split": str, "frames": _pair, "stride": _pair, "weight": float}
