"""The training step of `configs/h20.py`: what it needs and how fast it is, for 1 to 4 clips of twelve frames."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import optax
from jax.sharding import Mesh

from logvggt_jax.compile import out_of_device_memory
from logvggt_jax.doctor.finding import Finding
from logvggt_jax.doctor.inference import attention_calls
from logvggt_jax.doctor.subject import Subject, random_variables
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.parameters import stack_layers
from logvggt_jax.operations import matmul_flops_per_second
from logvggt_jax.training.config import LossConfig, OptimizerConfig
from logvggt_jax.training.parallel.sharding import data_mesh, parameter_layout, replicated, split
from logvggt_jax.training.step.costs import step_flops
from logvggt_jax.training.step.freezing import ENCODER
from logvggt_jax.training.step.optimizer import make_optimizer
from logvggt_jax.training.step.state import TrainState, initial_state
from logvggt_jax.training.step.train_step import make_loss_terms, make_train_step

# As configs/h20.py has them; what they are changes no time.
LOSS = LossConfig(
    name="log_vggt",
    camera_weight=1.0,
    depth_weight=1.0,
    translation_weight=1.0,
    rotation_weight=1.0,
    field_of_view_weight=0.5,
    gamma=0.6,
    alpha=0.2,
)
OPTIMIZER = OptimizerConfig(
    learning_rate=5e-5,
    final_learning_rate=1e-8,
    schedule="cosine",
    warmup_fraction=0.05,
    restart_each_stage=True,
    b1=0.9,
    b2=0.999,
    weight_decay=0.05,
    decay_all=False,
    clip_norm=1.0,
)
# No other number of clips is begun that would end later than this.
_SECONDS = 110.0


def examine(subject: Subject) -> Iterator[Finding]:
    """Steps of 4 clips, of what `configs/h20.py` gives a device, then of 1, 2 and 3, as many as there is time for."""
    model, mesh = subject.model, data_mesh(1)
    length = 3 if subject.tiny else 12
    # On the host: the device holds one state at a time.
    params = jax.tree.map(np.asarray, stack_layers(random_variables(model))["params"])
    step, optimizer = h20_step(model, params, mesh)
    peak = matmul_flops_per_second("bfloat16", size=256 if subject.tiny else None)
    begun = time.perf_counter()
    # In one program: by itself each shape of a moment would be one more to compile.
    beside = jax.jit(
        lambda params: initial_state(params, optimizer)._replace(params=None), out_shardings=replicated(mesh)
    )
    for clips in (1,) if subject.tiny or subject.quick else (4, 1, 2, 3):
        name, started = f"{clips} clips of {length} frames", time.perf_counter()
        placed = jax.device_put(params, replicated(mesh))
        state = beside(placed)._replace(params=placed)
        batch = jax.device_put(_clips(clips, length, subject.image_size), split(mesh))
        try:
            yield from _measured(name, step, state, batch, peak, subject)
        except jax.errors.JaxRuntimeError as error:
            if not out_of_device_memory(error):
                raise
            yield Finding("training", name, "does not fit the device's memory", note="fewer clips a device: batch_size")
        del state, placed, batch
        now = time.perf_counter()
        if 2 * now - started - begun > _SECONDS:  # another one would take as long as this one
            return


def h20_step(model: LogVGGT, params: Any, mesh: Mesh) -> tuple[jax.stages.Wrapped, optax.GradientTransformation]:
    """The training step of `configs/h20.py` for a model whose layers are stacked in `params` (arrays, or their shapes),
    and its optimiser, see `make_train_step`."""
    optimizer = make_optimizer(OPTIMIZER, params, frozen=(ENCODER,))
    layout = parameter_layout(params, mesh, shard=False)
    return make_train_step(make_loss_terms(model, LOSS), LOSS, optimizer, lambda _: 1e-6, layout), optimizer


def _measured(
    name: str, step: jax.stages.Wrapped, state: TrainState, batch: Any, peak: float, subject: Subject
) -> Iterator[Finding]:
    """Compilation, memory and time of a step; the state is donated to it."""
    started = time.perf_counter()
    program = step.lower(state, batch).compile()
    yield Finding("training", f"{name}: compilation", time.perf_counter() - started, "s")
    if (calls := attention_calls(program)) is not None:
        # Layers and windows are loops, so that a call is in the program once and runs many times.
        yield Finding("training", f"{name}: fast attention calls", float(calls), ok=calls > 0)
    memory: Any = program.memory_analysis()
    yield Finding("training", f"{name}: arguments", memory.argument_size_in_bytes / 2**30, "GiB")
    yield Finding("training", f"{name}: temporaries", memory.temp_size_in_bytes / 2**30, "GiB")
    state, metrics, _ = program(state, batch)
    jax.block_until_ready(metrics)
    started, rounds = time.perf_counter(), 1 if subject.tiny else 3
    for _ in range(rounds):
        state, metrics, _ = program(state, batch)
    jax.block_until_ready(metrics)
    seconds, loss = (time.perf_counter() - started) / rounds, float(metrics["loss/total"])
    clips, length = batch["images"].shape[:2]
    yield Finding("training", f"{name}: loss", loss, ok=bool(np.isfinite(loss)))
    yield Finding("training", f"{name}: step", seconds, "s", note=f"{clips * length / seconds:.4g} frames/s")
    operations = step_flops(subject.model.config, batch["images"].shape[:4], frozen=(ENCODER,))
    yield Finding("training", f"{name}: utilisation", operations / seconds / peak, note="without recomputation")


def _clips(clips: int, length: int, image_size: tuple[int, int]) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(0)
    height, width = image_size
    extrinsics = np.tile(np.eye(4, dtype=np.float32), (clips, length, 1, 1))
    extrinsics[..., 0, 3] = 0.1 * np.arange(length)
    intrinsics = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], np.float32)
    return {
        "images": generator.integers(0, 256, (clips, length, *image_size, 3), np.uint8),
        "depth": generator.uniform(1, 4, (clips, length, *image_size)).astype(np.float32),
        "intrinsics": np.tile(intrinsics, (clips, length, 1, 1)),
        "extrinsics": extrinsics,
    }
