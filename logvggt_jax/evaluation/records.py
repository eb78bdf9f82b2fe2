"""Results of single clips, one JSON line each, written as they come and found again by a later run."""

import hashlib
import json
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from logvggt_jax.errors import MissingInput, disk_errors, printable
from logvggt_jax.files import open_regular, write_text

RECORDS_FILE = "clips.jsonl"  # every evaluation's folder has it
FIGURES_FOLDER = "figures"
PREDICTION = "prediction"  # the group under which a method's own failure is recorded
_LINES_NAMED = 5


class ClipRecords:
    """The file `clips.jsonl` of an evaluation.

    A record belongs to a key: a digest of everything that its numbers depend on. Records of earlier runs with the keys
    asked for are taken over, so that a killed evaluation goes on where it stopped. All others stay in the file until
    `keep_asked`, so that an evaluation which never ends destroys nothing. A method that failed is tried again. Lines
    that were cut off or damaged are left out with a warning, and their clips are measured again.

    Before the records of an environment stands a line {"environment": …}; each record names its digest, and has one of
    its own. (Those of earlier versions have none, and count.)
    """

    def __init__(self, path: Path, keys: Sequence[str], environment: Mapping[str, Any], *, fresh: bool = False) -> None:
        """Reads what is there, unless a `fresh` run is asked for; nothing is written before `add`."""
        self._path, self._asked = path, set(keys)
        self._environment = plain(environment)
        self._records: dict[str, dict[str, Any]] = {}
        self._known: dict[str, dict[str, Any]] = {}
        try:
            with open_regular(path) as stream:
                content = stream.read()
        except MissingInput:
            content = b""
        # A line that was cut off must not swallow the next one.
        self._break = "" if content.endswith(b"\n") or not content else "\n"
        damaged: list[int] = []
        for number, line in _lines(content):
            if line.keys() == {"environment"}:
                self._known[record_key(line["environment"])] = line["environment"]
            elif not _is_record(line):
                damaged.append(number)
            elif not fresh and line["key"] in self._asked and PREDICTION not in line["failures"]:
                self._records[line["key"]] = line
        if damaged:
            _warn_of(path, damaged)

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
        stored = plain({"key": key, "environment": digest, **record})
        self._records[key] = {**stored, "digest": record_key(stored)}
        self._append(self._break + "".join(map(_line, [*lines, self._records[key]])))
        self._break = ""

    def claim(self) -> None:
        """Makes the file if there is none, before anything else comes to its folder."""
        self._append("")

    def keep_asked(self) -> None:
        """Rewrites the file with the records asked for alone."""
        lines = [*({"environment": each} for each in self.environments), *self._records.values()]
        write_text(self._path, "".join(map(_line, lines)))

    def _append(self, text: str) -> None:
        with disk_errors(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a") as file:
                file.write(text)


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


def _lines(content: bytes) -> Iterator[tuple[int, dict[str, Any]]]:
    """Number and values of every line; none where it is no object."""
    for number, line in enumerate(content.split(b"\n"), start=1):
        if not line:
            continue
        try:
            values = json.loads(line)
        except (ValueError, RecursionError):
            values = None
        yield number, values if isinstance(values, dict) else {}


def _is_record(line: Mapping[str, Any]) -> bool:
    """Whether a line holds what `add` has written."""
    rest = {key: value for key, value in line.items() if key != "digest"}
    if "digest" in line:
        return line["digest"] == record_key(rest)
    return rest.keys() == _FIELDS.keys() and all(check(rest[field]) for field, check in _FIELDS.items())


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_count(value: object) -> bool:
    return isinstance(value, int)


def _are_metrics(value: object) -> bool:
    return isinstance(value, dict) and all(item is None or isinstance(item, int | float) for item in value.values())


def _are_figures(value: object) -> bool:
    """Pictures in the folder of figures, and nowhere else; None where nothing was drawn."""
    return value is None or (
        isinstance(value, list)
        and all(isinstance(name, str) and PurePosixPath(name).parent == PurePosixPath(FIGURES_FOLDER) for name in value)
    )


# What the records of versions without digests hold.
_FIELDS = {
    "key": _is_text,
    "environment": _is_text,
    "benchmark": _is_text,
    "sequence": _is_text,
    "frames": lambda value: value is None or _is_count(value),
    "method": _is_text,
    "frames_used": _is_count,
    "indices": lambda value: isinstance(value, list) and all(map(_is_count, value)),
    "metrics": _are_metrics,
    "failures": lambda value: isinstance(value, dict) and all(map(_is_text, value.values())),
    "figures": _are_figures,
}


def _warn_of(path: Path, damaged: Sequence[int]) -> None:
    numbers = ", ".join(map(str, damaged[:_LINES_NAMED])) + (", …" if len(damaged) > _LINES_NAMED else "")
    lines = f"line {numbers} is" if len(damaged) == 1 else f"{len(damaged)} lines ({numbers}) are"
    warnings.warn(
        f"{printable(str(path))}: {lines} cut off or damaged and left out; the clips are measured again", stacklevel=3
    )
