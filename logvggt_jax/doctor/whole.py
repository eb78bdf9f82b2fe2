"""From files to files: `reconstruct` on a rendered sequence, and what a frame costs the host."""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import jax
from PIL import Image

from logvggt_jax.data.registry import open_dataset
from logvggt_jax.doctor.finding import Finding
from logvggt_jax.doctor.subject import Subject, random_variables
from logvggt_jax.model.parameters import in_compute_type
from logvggt_jax.reconstruction import open_source, reconstruct

_RENDERED = 4  # distinct frames, shown in turn: rendering is not what is measured


def examine(subject: Subject) -> Iterator[Finding]:
    """A sequence of JPEGs, once to compile and once to be timed."""
    size = (60, 80) if subject.tiny else (480, 640)
    # Fewer than the 256 for which a stream's buffers are made: while it is timed they do not grow, nor does it compile.
    count = 6 if subject.tiny else 60 if subject.quick else 240
    rooms = open_dataset("rooms", None, "test", num_rooms=1, num_frames=_RENDERED, height=size[0], width=size[1])
    pictures = rooms.read(rooms.sequences[0], range(_RENDERED)).images
    # As streams hold them, so that neither the cast nor the way to the device is timed.
    variables = jax.device_put(in_compute_type(random_variables(subject.model), subject.model.config))
    with tempfile.TemporaryDirectory() as temporary, warnings.catch_warnings():
        # Random parameters have no field of view worth the name.
        warnings.simplefilter("ignore")
        folder = Path(temporary) / "frames"
        folder.mkdir()
        for index in range(count):
            Image.fromarray(pictures[index % _RENDERED]).save(folder / f"{index:05d}.jpg", quality=92)
        for name, frames in (("first", 6), ("timed", count)):
            started, cores = time.perf_counter(), time.process_time()
            result = reconstruct(
                open_source(folder, max_frames=frames),
                Path(temporary) / name,
                model=subject.model,
                variables=variables,
                longer_edge=max(subject.image_size),
                progress=False,
            )
            seconds, cores = time.perf_counter() - started, time.process_time() - cores
    yield Finding("whole", "frames", float(result.num_frames), ok=result.num_frames == count)
    yield Finding("whole", "rate, files to files", count / seconds, "frames/s")
    assert result.seconds is not None  # it was made just now
    yield Finding("whole", "rate, first frame to last", count / result.seconds, "frames/s")
    # On a CPU this is the model as well.
    note = "the model included" if jax.default_backend() == "cpu" else "all threads of this process"
    yield Finding("whole", "processor time a frame", 1e3 * cores / count, "ms", note=note)
