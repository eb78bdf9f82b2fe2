"""Results of single clips, one JSON line each, written as they come and found again by a later run."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from logvggt_jax.files import write_text

PREDICTION = "prediction"  # the group under which a method's own failure is recorded


class ClipRecords:
    """The file `clips.jsonl` of an evaluation.

    A record belongs to a key: a digest of everything that its numbers depend on. Records of an earlier run with the
    keys asked for are taken over, so that a killed evaluation goes on where it stopped; all others are dropped, as is a
    line that was cut off. A method that failed is tried again.

    Every run starts with a line {"environment": …}.
    """

    def __init__(self, path: Path, keys: Sequence[str], environment: Mapping[str, Any]) -> None:
        """Reads what is there; nothing is written before `writing`."""
        self._path = path
        self._records: dict[str, dict[str, Any]] = {}
        self.environments: list[dict[str, Any]] = []
        asked = set(keys)
        for line in _lines(path):
            if "environment" in line:
                self.environments.append(line["environment"])
            elif line.get("key") in asked and PREDICTION not in line["failures"]:
                self._records[line["key"]] = line
        if not self._records:
            self.environments = []
        if not self.environments or len(self._records) < len(asked):
            self.environments.append(dict(environment))

    def __contains__(self, key: str) -> bool:
        return key in self._records

    def __getitem__(self, key: str) -> dict[str, Any]:
        return self._records[key]

    def __len__(self) -> int:
        return len(self._records)

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """`add` writes while this is open. A file without any record is taken away again."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        try:
            kept = [{"environment": each} for each in self.environments] + list(self._records.values())
            write_text(self._path, "".join(_line(record) for record in kept))
            yield
        finally:
            if not self._records:
                self._path.unlink(missing_ok=True)
                if not any(self._path.parent.iterdir()):
                    self._path.parent.rmdir()

    def add(self, key: str, record: Mapping[str, Any]) -> None:
        """Appends one record and keeps it under its key."""
        self._records[key] = plain({"key": key, **record})
        with self._path.open("a") as file:
            file.write(_line(self._records[key]))


def record_key(*parts: Any) -> str:
    """Digest of JSON values."""
    return hashlib.blake2b(json.dumps(plain(parts), sort_keys=True).encode(), digest_size=12).hexdigest()


def plain(value: Any) -> Any:
    """Values as JSON knows them: a number that is not finite becomes null."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _line(record: Mapping[str, Any]) -> str:
    return json.dumps(record) + "\n"


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    if not path.is_file():
        return
    for text in path.read_text().splitlines():
        with contextlib.suppress(ValueError):
            line = json.loads(text)
            if isinstance(line, dict):
                yield line
