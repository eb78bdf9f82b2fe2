"""The inference step: which kernels it has, what it needs, how fast it is."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.doctor.finding import Finding
from logvggt_jax.doctor.subject import Subject, random_variables
from logvggt_jax.model.initialization import variable_shapes
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.parameters import in_compute_type, stack_layers
from logvggt_jax.operations import count_flops, matmul_flops_per_second

# How compiled programs call the fast attention of a platform.
ATTENTION_CALLS = {"gpu": "__cudnn$fmha", "tpu": "tpu_custom_call"}


def examine(subject: Subject) -> Iterator[Finding]:
    """One step of s new frames, as a stream runs it when no frame is padding."""
    model = subject.model
    stride = model.config.windows.stride
    variables = in_compute_type(random_variables(model), model.config)
    # One loop over layers compiles in a fraction of the time; streams run them one by one, which is faster.
    variables = jax.device_put(stack_layers(variables) if subject.quick else variables)
    state, frames = step_inputs(subject, variables)
    started = time.perf_counter()
    step = jax.jit(model.step, donate_argnums=1).lower(variables, state, frames).compile()
    yield Finding("inference", "compilation", time.perf_counter() - started, "s")
    if (calls := attention_calls(step)) is not None:
        wanted = _num_attentions(model)
        note = f"in loops that run {wanted}" if subject.quick else f"of {wanted}"
        yield Finding(
            "inference",
            "fast attention calls",
            float(calls),
            ok=calls > 0 if subject.quick else calls == wanted,
            note=note,
        )
    memory: Any = step.memory_analysis()
    for what, size in (("arguments", memory.argument_size_in_bytes), ("temporaries", memory.temp_size_in_bytes)):
        yield Finding("inference", what, size / 2**30, "GiB")

    count = 4 if subject.tiny else 20 if subject.quick else 60
    inputs = jax.eval_shape(lambda s, f: (s, f), state, frames)
    seconds = step_seconds(step, variables, state, frames, count)
    yield Finding(
        "inference",
        "step, back to back",
        1e3 * seconds,
        "ms",
        note=f"{stride} new frames{', layers as a loop' if subject.quick else ''}",
    )
    yield Finding("inference", "rate", stride / seconds, "frames/s")
    plain = LogVGGT(dataclasses.replace(model.config, attention="xla"))
    operations = count_flops(plain.step, variable_shapes(plain.config), *inputs)
    peak = matmul_flops_per_second("bfloat16", size=256 if subject.tiny else None)
    yield Finding("inference", "operations of a step", operations / 1e12, "TFLOP")
    yield Finding("inference", "fastest large product", peak / 1e12, "TFLOP/s")
    yield Finding(
        "inference", "utilisation", operations / seconds / peak, note="operations a second over that product's"
    )


def step_inputs(subject: Subject, variables: Any) -> tuple[Any, jax.Array]:
    """A stream's state and the new frames of its next step."""
    model = subject.model
    held = jax.ShapeDtypeStruct((1, model.windows.overlap, *subject.image_size, 3), jnp.uint8)
    # Values do not matter: nothing has to be compiled for them.
    state = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(model.start, variables, held))
    shape = (1, model.config.windows.stride, *subject.image_size, 3)
    return state, jnp.asarray(np.random.default_rng(1).integers(0, 256, shape, np.uint8))


def step_seconds(step: Any, variables: Any, state: Any, frames: jax.Array, count: int) -> float:
    """Of one of `count` steps back to back; `state` is donated."""
    state, out = step(variables, state, frames)
    jax.block_until_ready(out)
    started = time.perf_counter()
    for _ in range(count):
        state, out = step(variables, state, frames)
    jax.block_until_ready(out)
    return (time.perf_counter() - started) / count


def attention_calls(program: jax.stages.Compiled) -> int | None:
    """Calls of the platform's fast attention in a compiled program; None where the platform has none (CPUs)."""
    call = ATTENTION_CALLS.get(jax.default_backend())
    return None if call is None else (program.as_text() or "").count(call)


def _num_attentions(model: LogVGGT) -> int:
    """Attentions over patches in a step: the encoder's, and two a layer of the aggregator."""
    return model.config.encoder.depth + 2 * model.config.aggregator.depth
