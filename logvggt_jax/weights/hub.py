"""Checkpoint files from the Hugging Face hub (extra `hub`)."""

from __future__ import annotations

import re
from pathlib import Path

from logvggt_jax.errors import MissingInput, MissingPackage
from logvggt_jax.weights.files import WEIGHT_FILES

_REPOSITORY = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*")


def resolve(path_or_repo: str | Path) -> Path:
    """The local path that a path or hub repository name means; downloads in the second case.

    What exists on disk is a path. Anything else of the form `owner/name`, without a checkpoint's suffix, is a
    repository.

    Raises:
      FileNotFoundError: As `download`; or neither a path that exists nor a repository name.
    """
    path = Path(path_or_repo).expanduser()
    if path.exists():
        return path
    name = str(path_or_repo)
    if _REPOSITORY.fullmatch(name) and not name.endswith((".safetensors", ".pt")):
        return download(name)
    raise MissingInput(
        f"{path}: no such file or folder; give a checkpoint file, its folder, or a hub repository as owner/name"
    )


def download(repository: str) -> Path:
    """Fetches the repository's `model.safetensors`, or `model.pt` where it has none, into the hub's cache.

    Args:
      repository: `owner/name`, as in `facebook/VGGT-1B`.

    Returns:
      Path of the file in the cache; a file that is there already is not fetched again.

    Raises:
      FileNotFoundError: The repository does not exist or asks for a login, holds neither file, or the hub cannot
        be reached and the cache has no copy.
      ImportError: `huggingface_hub` is not installed.
    """
    try:
        import huggingface_hub
        from huggingface_hub import errors
    except ImportError as error:
        raise MissingPackage(
            f"{repository}: reading from the hub needs huggingface_hub; "
            'pip install "logvggt-jax[hub]" or download the file and give its path'
        ) from error
    for name in WEIGHT_FILES:
        try:
            return Path(huggingface_hub.hf_hub_download(repository, name))
        except errors.RepositoryNotFoundError as error:  # a gated repository raises a subclass
            raise MissingInput(
                f"{repository}: no such repository on the hub, or it needs a login; check the name, "
                "accept its licence on its page and run `hf auth login`"
            ) from error
        except errors.LocalEntryNotFoundError as error:
            raise MissingInput(
                f"{repository}: the hub cannot be reached and its cache on this machine has no {name}; "
                "connect, or download the file elsewhere and give its path"
            ) from error
        except errors.RemoteEntryNotFoundError:
            continue
    raise MissingInput(f"{repository}: the repository holds no {' or '.join(WEIGHT_FILES)}; give a file's path")
