"""Results of single clips, one JSON line each, written as they come and found again by a later run."""

import contextlib
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from logvggt_jax.errors import disk_errors
from logvggt_jax.files import write_text

PREDICTION = "prediction"  # the group under which a method's own failure is recorded


class ClipRecords:
    """The file `clips.jsonl` of an evaluation.

    A record belongs to a key: a digest of everything that its numbers depend on. Records of earlier runs with the keys
    asked for are taken over, so that a killed evaluation goes on where it stopped. All others stay in the file until
    `keep_asked`, so that an evaluation which never ends destroys nothing. A method that failed is tried again, and a
    line that was cut off is passed over.

    Before the records of an environment stands a line {"environment": …}; each record names its digest.
    """

    def __init__(self, path: Path, keys: Sequence[str], environment: Mapping[str, Any], *, fresh: bool = False) -> None:
        """Reads what is there, unless a `fresh` run is asked for; nothing is written before `add`."""
        self._path, self._asked = path, set(keys)
        self._environment = plain(environment)
        self._records: dict[str, dict[str, Any]] = {}
        self._known: dict[str, dict[str, Any]] = {}
        text = path.read_text() if path.is_file() else ""
        # A line that was cut off must not swallow the next one.
        self._break = "" if text.endswith("\n") or not text else "\n"
        for line in _lines(text):
            if "environment" in line and "key" not in line:
                self._known[record_key(line["environment"])] = line["environment"]
            elif not fresh and line.get("key") in self._asked and PREDICTION not in line["failures"]:
                self._records[line["key"]] = line

    def __contains__(self, key: str) -> bool:
        return key in self._records

    def __getitem__(self, key: str) -> dict[str, Any]:
        return self._records[key]

    def __len__(self) -> int:
        return len(self._records)

    @property
    def environments(self) -> list[dict[str, Any]]:
        """Those in which the records asked for were measured."""
        used = {record["environment"] for record in self._records.values()}
        return [environment for digest, environment in self._known.items() if digest in used]

    def add(self, key: str, record: Mapping[str, Any]) -> None:
        """Appends one record and keeps it under its key."""
        digest = record_key(self._environment)
        lines = [] if digest in self._known else [{"environment": self._environment}]
        self._known[digest] = self._environment
        self._records[key] = plain({"key": key, "environment": digest, **record})
        with disk_errors(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a") as file:
                file.write(self._break + "".join(map(_line, [*lines, self._records[key]])))
        self._break = ""

    def keep_asked(self) -> None:
        """Rewrites the file with the records asked for alone."""
        lines = [*({"environment": each} for each in self.environments), *self._records.values()]
        write_text(self._path, "".join(map(_line, lines)))


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


def _lines(text: str) -> Iterator[dict[str, Any]]:
    for line in text.splitlines():
        with contextlib.suppress(ValueError):
            values = json.loads(line)
            if isinstance(values, dict):
                yield values
