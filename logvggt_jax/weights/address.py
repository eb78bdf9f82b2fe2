"""What a user means by a checkpoint: a path here, a model that ships, or a repository on the hub."""

import difflib
import re
from pathlib import Path

from logvggt_jax.errors import MissingInput, disk_errors
from logvggt_jax.files import user_path
from logvggt_jax.weights.files import SUFFIXES
from logvggt_jax.weights.folder import run_model
from logvggt_jax.weights.hub import PREFIX, download
from logvggt_jax.weights.shipped_models import SHIPPED, shipped_model

_NAME = r"[\w-][\w.-]*"
_HUB = re.compile(rf"(?P<repository>{_NAME}/{_NAME})(?:/(?P<file>.+))?")
_URL = re.compile(r"[a-z][a-z0-9+.-]*://(?P<host>[^/]*)/(?P<path>.*)", re.IGNORECASE)
_HUB_HOST = "huggingface.co"


def resolve(path_or_repo: str | Path) -> Path:
    """The local path that a path, the name of a model that ships (`shipped_model`) or an address on the hub means, for
    `from_pretrained` and its kin; downloads in the last case, after a line that says so.

    A `Path` is always local, and what this returns means itself. The folder of a training run means its `model`, a
    repository's folder in the hub's cache its newest snapshot. Raises MissingInput as `download`, or naming similar
    paths for what is neither a path that exists nor an address.
    """
    found = hub_address(path_or_repo)
    if found is not None:
        return download(*found)
    if isinstance(path_or_repo, str) and path_or_repo.startswith(PREFIX):
        raise MissingInput(
            f"{path_or_repo}: no address on the hub; expected {PREFIX}owner/name, or {PREFIX}owner/name/file"
        )
    if shipped := shipped_model(path_or_repo):
        return shipped
    if isinstance(path_or_repo, str) and (url := _URL.fullmatch(path_or_repo)):
        known = _HUB.fullmatch(url["path"]) if url["host"] == _HUB_HOST else None
        written = f"{PREFIX}{known['repository']}" if known else f"{PREFIX}owner/name"
        raise MissingInput(
            f"{path_or_repo}: a checkpoint is a file or folder here, or a repository on the hub, written {written}; "
            "download what lies elsewhere"
        )
    path = user_path(path_or_repo)
    with disk_errors(path):
        there = path.exists() or path.is_symlink()
    if not there:
        raise MissingInput(
            f"{path}: no such file or folder{similar(path)}; give a checkpoint file, its folder, a hub repository as "
            f"{PREFIX}owner/name, or a model that ships with this package: {', '.join(SHIPPED)}"
        )
    return _snapshot(path) or run_model(path)


def hub_address(path_or_repo: str | Path) -> tuple[str, str | None] | None:
    """Repository and file of an address on the hub; None for a path.

    `hf:owner/name` and `hf:owner/name/file` are addresses, and so is `owner/name` where it cannot be a path: no folder
    `owner` is here and the name has no checkpoint's suffix.
    """
    if isinstance(path_or_repo, Path):
        return None
    match = _HUB.fullmatch(path_or_repo.removeprefix(PREFIX))
    if match is None:
        return None
    local = match["file"] or path_or_repo.lower().endswith(SUFFIXES) or Path(path_or_repo).parent.exists()
    return (match["repository"], match["file"]) if path_or_repo.startswith(PREFIX) or not local else None


def similar(path: Path) -> str:
    """A question about paths that exist and are spelt like a missing one, for the end of an error; or nothing."""
    missing = path
    while not missing.parent.is_dir() and missing.parent != missing:
        missing = missing.parent
    try:
        names = [entry.name for entry in missing.parent.iterdir()]
    except OSError:
        return ""
    close = [missing.parent / name for name in difflib.get_close_matches(missing.name, names, 3)]
    found = [str(start / path.relative_to(missing)) for start in close if (start / path.relative_to(missing)).exists()]
    return f", did you mean {' or '.join(found)}?" if found else ""


def _snapshot(path: Path) -> Path | None:
    """Of a repository's folder in the hub's cache, the snapshot that its branch `main` names, or the only one."""
    snapshots, main = path / "snapshots", path / "refs" / "main"
    if not (path.name.startswith("models--") and snapshots.is_dir()):
        return None
    if main.is_file() and (snapshots / main.read_text().strip()).is_dir():
        return snapshots / main.read_text().strip()
    folders = [folder for folder in snapshots.iterdir() if folder.is_dir()]
    return folders[0] if len(folders) == 1 else None
