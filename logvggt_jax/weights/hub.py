"""Checkpoint files from the Hugging Face hub (extra `hub`)."""

from pathlib import Path
from typing import Any

from rich.console import Console

from logvggt_jax.errors import InputError, MissingInput, MissingPackage, install_line, one_line
from logvggt_jax.weights.files import choose_weights
from logvggt_jax.weights.shards import INDEX_SUFFIX, read_index

PREFIX = "hf:"
_TIMEOUT = 10.0  # seconds for the hub's answer, not for a download


def licence(repository: str) -> str | None:
    """The licence that a repository `owner/name` names for itself; None where it cannot be asked."""
    card = getattr(_ask(repository), "card_data", None)
    return None if card is None else card.get("license_name") or card.get("license")


def download(repository: str, file: str | None = None) -> Path:
    """Fetches the weights of `owner/name` into the hub's cache, unless they are there; the path of the file in the
    cache. A line on standard error says what is downloaded, from where and how much, before it begins.

    `file` is one of the repository's, None takes the one that `choose_weights` finds; with an index come its shards.
    Raises MissingInput where the repository does not exist or asks for a login, holds no such file, or the hub cannot
    be reached and the cache has no copy; InputError naming several files of weights, or for a download that fails;
    MissingPackage without `huggingface_hub`.
    """
    hub = _client(repository)
    try:
        if file is None:
            info, where = _ask(repository), f"{repository} on the hub"
            if info is None:  # what the cache has of it
                where = f"{repository} in this machine's cache (the hub cannot be reached)"
                folder = Path(hub.snapshot_download(repository, local_files_only=True))
                names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
            else:
                names = [sibling.rfilename for sibling in info.siblings or ()]
            file = choose_weights(names, where, f"{PREFIX}{repository}/")
        path = _fetch(hub, repository, file)
        if file.endswith(INDEX_SUFFIX):
            for shard in dict.fromkeys(read_index(path).values()):
                file = (Path(file).parent / shard).as_posix()
                _fetch(hub, repository, file)
        return path
    except InputError:
        raise
    except hub.errors.RepositoryNotFoundError as error:  # a gated repository raises a subclass
        raise _not_found(repository) from error
    except hub.errors.LocalEntryNotFoundError as error:
        raise MissingInput(
            f"{repository}: no such path here, the hub cannot be reached, and its cache on this machine has no "
            f"{file or 'copy'}; check the path, or connect, or download the file elsewhere and give its path"
        ) from error
    except hub.errors.RemoteEntryNotFoundError as error:
        raise MissingInput(f"{repository}: the repository holds no {file}; look for the name on its page") from error
    except Exception as error:  # a full disk, a lost connection: the client's transport library has its own errors
        raise InputError(
            f"{repository}: {file or 'the repository'} cannot be downloaded ({type(error).__name__}: "
            f"{one_line(error):.200}); try again, or download the file elsewhere and give its path"
        ) from error


def _fetch(hub: Any, repository: str, file: str) -> Path:
    try:
        metadata = hub.get_hf_file_metadata(hub.hf_hub_url(repository, file), timeout=_TIMEOUT)
    except Exception:  # asked again below, where it counts
        metadata = None
    if metadata is not None:
        cached = hub.try_to_load_from_cache(repository, file, revision=metadata.commit_hash)
        if not isinstance(cached, str):
            size = f", {metadata.size / 1e6:,.1f} MB" if metadata.size else ""
            Console(stderr=True).print(
                f"downloading {repository}/{file}{size}, from {hub.constants.ENDPOINT}",
                soft_wrap=True,
                markup=False,
                highlight=False,
            )
    return Path(hub.hf_hub_download(repository, file))


def _ask(repository: str) -> Any:
    """What the hub says of a repository; None where it cannot be reached."""
    hub = _client(repository)
    try:
        return hub.HfApi(endpoint=hub.constants.ENDPOINT).model_info(repository, timeout=_TIMEOUT)
    except hub.errors.RepositoryNotFoundError as error:
        raise _not_found(repository) from error
    except hub.errors.HFValidationError as error:
        raise InputError(f"{repository}: no name of a repository ({one_line(error)}); expected owner/name") from error
    except Exception:  # what an unreachable host raises differs with the client's transport library
        return None


def _client(repository: str) -> Any:
    try:
        import huggingface_hub
        import huggingface_hub.constants
        import huggingface_hub.errors
    except ImportError as error:
        raise MissingPackage(
            f"{repository}: no such path here, and reading from the hub needs huggingface_hub; "
            f"{install_line('hub')} or download the file and give its path"
        ) from error
    return huggingface_hub


def _not_found(repository: str) -> MissingInput:
    return MissingInput(
        f"{repository}: no such repository on the hub, or it needs a login, and no such path here; check the name, "
        "accept its licence on its page and run `hf auth login`"
    )
