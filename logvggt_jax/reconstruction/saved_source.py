"""What a saved state remembers of its frames, so that a run goes on with the same ones or not at all."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from logvggt_jax.errors import InputError, OutputExists
from logvggt_jax.reconstruction.depth_files import depth_file, image_file, is_whole
from logvggt_jax.reconstruction.sources import Source, SourceOptions
from logvggt_jax.streaming.state_file import State

_ANEW = "pass --overwrite to start anew"


def source_facts(source: Source, num_taken: int, names: Sequence[str]) -> dict[str, Any]:
    """What to save of a source of which `num_taken` loaders were used, which gave the frames `names`."""
    return {
        "source": source.fingerprint(num_taken),
        "num_taken": num_taken,
        "masks": None if source.masks is None else source.masks.fingerprint(names),
        "frames_of": _described(source),
    }


def check_source(source: Source, facts: Mapping[str, Any], folder: Path) -> None:
    """Raises InputError where frames of `source` are not those that a run took whose state, with these facts, lies in
    `folder`; OutputExists where they were another source's, or taken by other options."""
    if source.fingerprint(facts["num_taken"]) != facts["source"]:
        then, now = facts.get("frames_of"), _described(source)  # None: of earlier versions
        if then not in (None, now):
            raise OutputExists(
                f"{folder} holds an unfinished reconstruction of {then}, not of {now}; give its source and options "
                f"to go on with it, choose another output, or {_ANEW}"
            )
        taken = "" if then else ", or are taken otherwise"
        raise InputError(
            f"{source.path} has changed since {folder} was left unfinished: frames that were read are other "
            f"ones{taken}; {_ANEW}"
        )
    masks = source.masks
    if (None if masks is None else masks.fingerprint(facts["names"])) != facts.get("masks"):
        raise InputError(f"the masks of frames that were read have changed since {folder} was left unfinished; {_ANEW}")


def check_frames(state: State, folder: Path) -> None:
    """Raises InputError where a frame that the run had written whose `state` lies in `folder` is gone or damaged."""
    for index, name in enumerate(state.facts["names"]):
        if f"images/{index}" in state.arrays:  # its depth is not final
            continue
        for file in (depth_file(folder, name), image_file(folder, name)):
            if not is_whole(file):
                raise InputError(f"{file}, of a frame that an earlier run has done, is missing or damaged; {_ANEW}")


def _described(source: Source) -> str:
    """Which source it is and which of its options are not the usual ones."""
    where = source.name if source.address is None else str(source.address.absolute())
    usual = dataclasses.asdict(SourceOptions())
    options = [f"{name}={value}" for name, value in dataclasses.asdict(source.options).items() if value != usual[name]]
    return f"{where} ({', '.join(options)})" if options else where
