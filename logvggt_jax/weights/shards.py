"""Checkpoints in several files, with an index that says which tensor lies in which."""

import re
from pathlib import Path

from logvggt_jax.errors import InputError, MissingInput
from logvggt_jax.files import read_json

INDEX_SUFFIX = ".index.json"
_SHARD = re.compile(r".*-(\d{5})-of-(\d{5})\.\w+")


def is_shard(name: str) -> bool:
    """Whether a file name is that of one shard of several, `model-00001-of-00002.safetensors`."""
    match = _SHARD.fullmatch(name)
    return match is not None and int(match[2]) > 1


def read_index(path: Path) -> dict[str, str]:
    """The weight map of an index, tensor names to file names beside it.

    Raises InputError for a JSON text that is no such index, or that names a file of another folder.
    """
    index = read_json(path, "so it is no index of shards; copy it again")
    weight_map = index.get("weight_map") if isinstance(index, dict) else None
    if not isinstance(weight_map, dict) or not weight_map:
        raise InputError(
            f"{path}: a JSON text, not weights, and no index of shards either (it has no weight_map); give the file of "
            "weights or its folder"
        )
    for tensor, name in weight_map.items():
        if not isinstance(name, str) or name in ("", ".", "..") or re.search(r"[/\\\0]", name):
            raise InputError(f"{path}: puts {tensor} into {name!r}, expected the name of a file beside the index")
    return weight_map


def present_shards(path: Path, weight_map: dict[str, str]) -> list[Path]:
    """The shards that an index names, in its order. Raises MissingInput naming those that are not there."""
    shards = [path.parent / name for name in dict.fromkeys(weight_map.values())]
    if missing := [shard.name for shard in shards if not shard.is_file()]:
        raise MissingInput(
            f"{path}: {len(missing)} of {len(shards)} shards are missing, {', '.join(missing[:4])}; put them beside "
            "the index"
        )
    return shards
