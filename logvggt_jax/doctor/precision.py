"""Products in eight bits (`reconstruct --precision`) against bfloat16: what they change, and the time of a step."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from logvggt_jax.data.registry import open_dataset
from logvggt_jax.doctor.finding import Finding
from logvggt_jax.doctor.inference import step_inputs, step_seconds
from logvggt_jax.doctor.subject import Subject, random_variables
from logvggt_jax.errors import MissingPackage
from logvggt_jax.geometry import camera_centres, rotation_angle
from logvggt_jax.model.low_precision import PRECISIONS, check_precision, in_low_precision
from logvggt_jax.model.parameters import in_compute_type, stack_layers
from logvggt_jax.weights import resolve
from logvggt_jax.weights.checkpoints import from_pretrained

_FRAMES = 8
# Mean relative difference of depth; int8 is at 0.001 and fp8 at 0.002 on a CPU, as far as bfloat16 is from float32.
_BOUND = 0.01


def examine(subject: Subject) -> Iterator[Finding]:
    """Errors of the shipped model on a rendered room; on an accelerator the large model's step as well."""
    try:
        notes = {precision: check_precision(precision) or "" for precision in PRECISIONS}
    except MissingPackage as error:
        yield Finding("precision", "products in eight bits", None, note=str(error))
        return
    yield from errors()
    if jax.default_backend() != "cpu":
        yield from step_times(subject, notes)


def errors() -> Iterator[Finding]:
    """Differences to bfloat16's depth and cameras, of the shipped model on a rendered room."""
    rooms = open_dataset("rooms", None, "test", num_rooms=1, num_frames=_FRAMES, height=56, width=70)
    images = rooms.read(rooms.sequences[0], range(_FRAMES)).images[None]
    model, variables = from_pretrained(resolve("rooms"), dtype="bfloat16")
    run = jax.jit(model.apply)

    def predicted(variables: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth, rotations, and centres of the cameras, in float64."""
        out: Any = jax.device_get(run(in_compute_type(variables, model.config), images))
        poses = out.extrinsics[0].astype(np.float64)
        return out.depth.astype(np.float64), poses[:, :3, :3], camera_centres(poses)

    depth, rotations, centres = predicted(variables)
    path = np.linalg.norm(np.diff(centres, axis=0), axis=-1).sum()
    for precision in PRECISIONS:
        found = predicted(in_low_precision(variables, precision))
        error = float(np.abs(found[0] / depth - 1.0).mean())
        note = f"mean relative difference to bfloat16's, at most {_BOUND:g}"
        yield Finding("precision", f"{precision}: depth", error, ok=error <= _BOUND, note=note)
        angle = float(np.degrees(rotation_angle(found[1], rotations)).mean())
        yield Finding("precision", f"{precision}: rotations", angle, "degrees", note="mean difference to bfloat16's")
        shift = float(np.linalg.norm(found[2] - centres, axis=-1).mean() / path)
        yield Finding("precision", f"{precision}: positions", shift, note="the same, over the path's length")


def step_times(subject: Subject, notes: dict[str, str]) -> Iterator[Finding]:
    """A step of the examined model, its layers as a loop, in bfloat16 and in eight bits; `notes` by precision."""
    plain = random_variables(subject.model)
    for precision in (None, *PRECISIONS):
        variables = plain if precision is None else in_low_precision(plain, precision)
        variables = jax.device_put(stack_layers(in_compute_type(variables, subject.model.config)))
        state, frames = step_inputs(subject, variables)
        step = jax.jit(subject.model.step, donate_argnums=1).lower(variables, state, frames).compile()
        seconds = step_seconds(step, variables, state, frames, 4 if subject.tiny else 20)
        note = notes.get(precision or "", "")
        yield Finding("precision", f"{precision or 'bfloat16'}: step, layers as a loop", 1e3 * seconds, "ms", note=note)
