"""Where a result's frames came from, so that they can be read again at their own size."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.sources import open_source
from logvggt_jax.reconstruction.sources.source import Source


class SourceRecord(NamedTuple):
    """A source as a result remembers it.

    Attributes:
      path: absolute path or glob.
      options: those of `SourceOptions`.
      taken: how many loaders were used.
      fingerprint: of those, see `Source.fingerprint`.
    """

    path: str
    options: dict[str, Any]
    taken: int
    fingerprint: str


def record_source(source: Source, taken: int) -> SourceRecord | None:
    """The record of a source of which `taken` loaders were used; None for a camera or a stream."""
    if source.address is None:
        return None
    options = dataclasses.asdict(source.options)
    return SourceRecord(str(source.address.absolute()), options, taken, source.fingerprint(taken))


def reopen(record: SourceRecord) -> Source:
    """The source that a record is of.

    Raises:
      InputError: it is not there any more, or holds other frames.
    """
    try:
        source = open_source(Path(record.path), **record.options)
    except TypeError as error:  # an option of another version
        raise InputError(f"{record.path}: {error}") from error
    # Another decoder's pictures are the same to a few grey levels: enough to look at, not to go on from.
    if source.fingerprint(record.taken).partition(" ")[0] != record.fingerprint.partition(" ")[0]:
        raise InputError(f"{record.path} has changed since")
    return source
