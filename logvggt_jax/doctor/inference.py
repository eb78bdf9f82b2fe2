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
from logvggt_jax.evaluation.costs.parts import abstract_variables, matmul_flops_per_second
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.parameters import in_compute_type
from logvggt_jax.operations import count_flops

_ATTENTION_CALLS = {"gpu": "__cudnn$fmha", "tpu": "tpu_custom_call"}


def examine(subject: Subject) -> Iterator[Finding]:
    """One step of s new frames, as a stream runs it when no frame is padding."""
    model, platform = subject.model, jax.default_backend()
    stride = model.config.windows.stride
    frames = jnp.asarray(np.random.default_rng(1).integers(0, 256, (1, stride, *subject.image_size, 3), np.uint8))
    held = jnp.asarray(np.resize(frames, (1, model.windows.overlap, *subject.image_size, 3)))
    variables = jax.device_put(in_compute_type(random_variables(model), model.config))
    state = jax.jit(model.start)(variables, held)
    started = time.perf_counter()
    step = jax.jit(model.step, donate_argnums=1).lower(variables, state, frames).compile()
    yield Finding("inference", "compilation", time.perf_counter() - started, "s")
    if platform in _ATTENTION_CALLS:
        calls, wanted = (step.as_text() or "").count(_ATTENTION_CALLS[platform]), _num_attentions(model)
        yield Finding("inference", "fast attention calls", float(calls), ok=calls == wanted, note=f"of {wanted}")
    memory: Any = step.memory_analysis()
    for what, size in (("arguments", memory.argument_size_in_bytes), ("temporaries", memory.temp_size_in_bytes)):
        yield Finding("inference", what, size / 2**30, "GiB")

    count = 4 if subject.tiny else 20 if subject.quick else 60
    state, out = step(variables, state, frames)
    jax.block_until_ready(out)
    started = time.perf_counter()
    for _ in range(count):
        state, out = step(variables, state, frames)
    jax.block_until_ready(out)
    seconds = (time.perf_counter() - started) / count
    yield Finding("inference", "step, back to back", 1e3 * seconds, "ms", note=f"{stride} new frames")
    yield Finding("inference", "rate", stride / seconds, "frames/s")
    plain = LogVGGT(dataclasses.replace(model.config, attention="xla"))
    operations = count_flops(plain.step, abstract_variables(plain), *jax.eval_shape(lambda s, f: (s, f), state, frames))
    peak = matmul_flops_per_second("bfloat16", size=256 if subject.tiny else None)
    yield Finding("inference", "operations of a step", operations / 1e12, "TFLOP")
    yield Finding("inference", "fastest large product", peak / 1e12, "TFLOP/s")
    yield Finding(
        "inference", "utilisation", operations / seconds / peak, note="operations a second over that product's"
    )


def _num_attentions(model: LogVGGT) -> int:
    """Attentions over patches in a step: the encoder's, and two a layer of the aggregator."""
    return model.config.encoder.depth + 2 * model.config.aggregator.depth
