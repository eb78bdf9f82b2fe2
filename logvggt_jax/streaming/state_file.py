"""A stream's state in a file: what a snapshot holds, which model it belongs to, and a digest of both."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from logvggt_jax.errors import DiskError, InputError, disk_errors, one_line
from logvggt_jax.files import atomic_file, to_disk
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.streaming.predictor import Predictor, known_method, open_predictor
from logvggt_jax.streaming.results import FrameResult
from logvggt_jax.weights.digests import digests, json_digest, named_leaves


class State(NamedTuple):
    """Arrays by name, and what else there is to know, as JSON takes it."""

    arrays: dict[str, np.ndarray]
    facts: dict[str, Any]


def save_stream(
    path: str | Path,
    predictor: Predictor,
    model: LogVGGT,
    variables: Variables,
    *,
    method: str = "windows",
    settings: Any = None,
) -> list[FrameResult]:
    """Writes the state of a stream, for `load_stream`; the frames that became final by now, oldest first.

    The stream goes on as if nothing had been asked. The file is replaced as a whole, and on the disk on return.

    Args:
      path: of the file, by custom `.safetensors`.
      predictor: the stream.
      model: its model.
      variables: {"params": …}, its parameters, by whose sizes and first values the file knows them.
      method: its name in `METHODS`.
      settings: of the method, as the stream was opened with them; None for its defaults.

    Raises:
      ValueError: the stream is closed, and has nothing to go on from.
      InputError: the method is not known.
      DiskError: the file cannot be written.
    """
    results, arrays = predictor.snapshot()
    if predictor.num_frames and not arrays:  # in place of an earlier state there would be one of no frames
        raise ValueError("this stream is closed: save a stream before it is closed")
    write_state(path, State(arrays, _facts(model, variables, method, settings)))
    return results


def load_stream(
    path: str | Path, model: LogVGGT, variables: Variables, *, method: str = "windows", settings: Any = None
) -> Predictor:
    """A stream that goes on where `save_stream` left it: it gives what that one would have given, to the same bits.

    Args:
      path: of the file.
      model: the stream's model.
      variables: {"params": …}, its parameters.
      method: its name in `METHODS`.
      settings: of the method; None for its defaults.

    Raises:
      InputError: the method is not known; the file is missing or damaged, or of another method, model or parameters, or
        of other settings.
    """
    state, facts = read_state(path), _facts(model, variables, method, settings)
    if others := sorted(name for name in facts if state.facts.get(name) != facts[name]):
        raise InputError(f"{path}: a stream that differs in {', '.join(others)}; give those that it was saved with")
    predictor = open_predictor(method, model, variables, settings)
    predictor.restore(state.arrays)
    return predictor


def write_state(path: str | Path, state: State) -> None:
    """Writes arrays and facts with their digest, whole or not at all, and on the disk on return. Raises DiskError."""
    path = Path(path)
    arrays = {name: np.ascontiguousarray(array) for name, array in state.arrays.items()}
    facts = json.dumps(state.facts)
    with disk_errors(path), atomic_file(path) as temporary:
        try:
            save_file(arrays, temporary, metadata={"facts": facts, "digest": _digest(facts, arrays)})
        except SafetensorError as error:  # what the library makes of a full disk
            raise DiskError(f"{path}: cannot be written ({one_line(error)})") from error
        to_disk([temporary])


def read_state(path: str | Path) -> State:
    """What `write_state` wrote. InputError where the file is missing or damaged."""
    try:
        with disk_errors(path), safe_open(path, "numpy") as stored:
            described = stored.metadata()
            arrays = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
        if described["digest"] != _digest(described["facts"], arrays):
            raise ValueError("its digest differs; or an earlier version wrote it")
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: damaged ({one_line(error)})") from error
    return State(arrays, json.loads(described["facts"]))


def _facts(model: LogVGGT, variables: Variables, method: str, settings: Any) -> dict[str, Any]:
    return {
        "method": method,
        "settings": str(known_method(method).chosen(settings)),
        "model": json_digest(model.config.to_dict()),
        "parameters": json_digest([[name, *_glimpse(leaf)] for name, leaf in named_leaves(variables)]),
    }


def _glimpse(leaf: Any) -> tuple[list[int], str, str]:
    """Shape, type and first values: enough to know parameters by, without reading gigabytes at every save."""
    return list(leaf.shape), leaf.dtype.name, np.asarray(leaf.reshape(-1)[:64]).tobytes().hex()


def _digest(facts: str, arrays: Mapping[str, np.ndarray]) -> str:
    return json_digest({"facts": facts, "arrays": digests(arrays)})
