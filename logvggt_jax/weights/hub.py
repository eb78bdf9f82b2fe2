"""Checkpoint files from the Hugging Face hub (extra `hub`)."""

import re
from pathlib import Path
from typing import Any

from logvggt_jax.errors import MissingInput, MissingPackage
from logvggt_jax.weights.files import SUFFIXES, choose_weights

_PREFIX = "hf:"
_NAME = r"[\w-][\w.-]*"
_ADDRESS = re.compile(rf"(?P<repository>{_NAME}/{_NAME})(?:/(?P<file>.+))?")
_TIMEOUT = 10.0  # seconds for the hub's answer, not for a download


def resolve(path_or_repo: str | Path) -> Path:
    """The local path that a path or an address on the hub means; downloads in the second case.

    Raises MissingInput as `download`, or for what is neither a path that exists nor an address.
    """
    found = _address(path_or_repo)
    if found is not None:
        return download(*found)
    path = Path(path_or_repo).expanduser()
    if not path.exists():
        raise MissingInput(
            f"{path}: no such file or folder; give a checkpoint file, its folder, or a hub repository as {_PREFIX}"
            "owner/name"
        )
    return path


def licence(path_or_repo: str | Path) -> str | None:
    """The licence that a hub repository names for itself; None for local paths, or where it cannot be asked."""
    found = _address(path_or_repo)
    card = None if found is None else getattr(_ask(found[0]), "card_data", None)
    return None if card is None else card.get("license_name") or card.get("license")


def download(repository: str, file: str | None = None) -> Path:
    """Fetches the weights of `owner/name` into the hub's cache, unless they are there; the path of the file in the
    cache.

    `file` is one of the repository's, None takes the one that `choose_weights` finds. Raises MissingInput where the
    repository does not exist or asks for a login, holds no such file, or the hub cannot be reached and the cache has no
    copy; InputError naming several files of weights; MissingPackage without `huggingface_hub`.
    """
    hub = _client(repository)
    try:
        if file is None:
            info = _ask(repository)
            if info is None:  # what the cache has of it
                folder = Path(hub.snapshot_download(repository, local_files_only=True))
                names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
            else:
                names = [sibling.rfilename for sibling in info.siblings or ()]
            file = choose_weights(names, f"{repository} on the hub", f"{_PREFIX}{repository}/")
        return Path(hub.hf_hub_download(repository, file))
    except hub.errors.RepositoryNotFoundError as error:  # a gated repository raises a subclass
        raise _not_found(repository) from error
    except hub.errors.LocalEntryNotFoundError as error:
        raise MissingInput(
            f"{repository}: the hub cannot be reached and its cache on this machine has no {file or 'copy'}; "
            "connect, or download the file elsewhere and give its path"
        ) from error
    except hub.errors.RemoteEntryNotFoundError as error:
        raise MissingInput(f"{repository}: the repository holds no {file}; look for the name on its page") from error


def _address(path_or_repo: str | Path) -> tuple[str, str | None] | None:
    """Repository and file of a hub address; None for a path.

    `hf:owner/name` and `hf:owner/name/file` are addresses, as is `owner/name` where no folder `owner` is here and
    the name has no checkpoint's suffix.
    """
    text = str(path_or_repo)
    match = _ADDRESS.fullmatch(text.removeprefix(_PREFIX))
    if match is None:
        return None
    local = match["file"] or text.endswith(SUFFIXES) or Path(text).parent.exists()
    return (match["repository"], match["file"]) if text.startswith(_PREFIX) or not local else None


def _ask(repository: str) -> Any:
    """What the hub says of a repository; None where it cannot be reached."""
    hub = _client(repository)
    try:
        return hub.HfApi(endpoint=hub.constants.ENDPOINT).model_info(repository, timeout=_TIMEOUT)
    except hub.errors.RepositoryNotFoundError as error:
        raise _not_found(repository) from error
    except Exception:  # what an unreachable host raises differs with the client's transport library
        return None


def _client(repository: str) -> Any:
    try:
        import huggingface_hub
        import huggingface_hub.constants
        import huggingface_hub.errors
    except ImportError as error:
        raise MissingPackage(
            f"{repository}: reading from the hub needs huggingface_hub; "
            'pip install "logvggt-jax[hub]" or download the file and give its path'
        ) from error
    return huggingface_hub


def _not_found(repository: str) -> MissingInput:
    return MissingInput(
        f"{repository}: no such repository on the hub, or it needs a login; check the name, accept its licence on its "
        "page and run `hf auth login`"
    )
