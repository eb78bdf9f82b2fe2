"""The description in a model folder, `config.json`, and how a model folder is told from others."""

import json
from pathlib import Path
from typing import Any

from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.files import open_regular, read_json
from logvggt_jax.weights.digests import MEND, json_digest

FORMAT = "logvggt-jax model"
VERSION = 1
_ENTRIES = {"format", "version", "config", "provenance", "digests", "libraries", "digest"}


def is_model_folder(path: Path) -> bool:
    """Whether a folder is one of this package's, be it damaged; hub repositories have a config.json as well."""
    with disk_errors(path):
        if (path / "params").is_dir():
            return True
    try:
        with open_regular(path / "config.json") as stream:
            return FORMAT.encode() in stream.read()
    except InputError:
        return False


def run_model(path: Path) -> Path:
    """The model folder of a training run's folder; any other path as it is."""
    return path / "model" if not is_model_folder(path) and is_model_folder(path / "model") else path


def write_description(folder: Path, content: dict[str, Any]) -> None:
    """Writes `config.json` with the format, its version and a digest of all that it says."""
    description = {"format": FORMAT, "version": VERSION, **content}
    description["digest"] = json_digest(description)
    (folder / "config.json").write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")


def read_description(path: Path) -> dict[str, Any]:
    """What `config.json` of a model folder says.

    Folders written before it had a digest are read as they are. Raises MissingInput where there is none; InputError
    where it is damaged, another version's, or differs from its digest.
    """
    file = path / "config.json"
    if not file.is_file():
        raise MissingInput(f"{file}: no such file{_why_no_model(path)}")
    description = read_json(file, MEND)
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise InputError(
            f"{file}: not the description of a model of this package (format {FORMAT!r}); turn VGGT's weights into one "
            "with `logvggt convert`"
        )
    if description.get("version") != VERSION:
        raise InputError(
            f"{file}: format version {description.get('version')!r}, this package reads {VERSION}; "
            "use the version of logvggt-jax that wrote it"
        )
    # An entry of another name may have been `digest` before a bit of it was flipped.
    if unknown := sorted(description.keys() - _ENTRIES):
        raise InputError(f"{file}: unknown entry {unknown[0]!r}, expected {', '.join(sorted(_ENTRIES))}; {MEND}")
    if "digest" in description:
        digest, found = description.pop("digest"), json_digest(description)
        if digest != found:
            raise InputError(
                f"{file}: differs from its digest ({found}, expected {digest!r:.40}); {MEND}; or, if it was edited on "
                "purpose, remove its entry 'digest'"
            )
    if not all(isinstance(description.get(part), dict) for part in ("config", "digests")):
        raise InputError(f"{file}: config or digests are missing; {MEND}")
    return description


def _why_no_model(path: Path) -> str:
    """What a path without a description is instead, and what to give; the end of an error's line."""
    if path.is_file():
        return f", {path.name} is a file and no model folder; turn VGGT's weights into one with `logvggt convert`"
    # Inside of a run: `checkpoints`, or one step of it.
    runs = [folder for folder in path.absolute().parents[:2] if is_model_folder(folder / "model")]
    if runs and path.is_dir():
        return f", so the folder is not a model's; the model of this training run is {runs[0] / 'model'}"
    what = ", so the folder is not a model's" if path.is_dir() else ""
    return f"{what}; give a folder made by `logvggt convert` or training"
