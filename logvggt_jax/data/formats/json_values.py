"""JSON in calibrations, annotations and lists, with the damage in it named."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from logvggt_jax.errors import InputError


def read_json(text: str | bytes, path: Path, hook: Callable[[dict], Any] | None = None) -> Any:
    """The value in the `text` of the file `path`; `hook` is called with every object in it and replaces it.

    Raises InputError naming `path` for what is no JSON, and where `hook` finds other values than it expects.
    """
    with expecting(path, "JSON as the data set has it"):
        try:
            return json.loads(text, object_hook=hook)
        except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise InputError(f"{path}: not JSON ({error}): fetch it again") from error


@contextmanager
def expecting(path: Path, content: str) -> Iterator[None]:
    """Turns what goes wrong in the block, which takes values out of the file `path`, into one line that names it.

    Damaged files have numbers where text belongs, text or infinity where a whole number belongs, or lists of another
    length; `content` says what is expected.
    """
    try:
        yield
    except InputError:
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected {content} ({type(error).__name__}: {error}): fetch it again") from error


def text_of(value: Any) -> str:
    """`value`, which must be text; TypeError otherwise."""
    if not isinstance(value, str):
        raise TypeError(f"expected text, got {value!r:.40}")
    return value
