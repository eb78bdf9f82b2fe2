"""What a stream costs: the parts of the model, their operations, time, compilation and memory."""

import dataclasses
import functools
import resource
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from logvggt_jax.model.aggregator import WindowTokens
from logvggt_jax.model.initialization import variable_shapes
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.refinement import Span, num_triggers
from logvggt_jax.model.windows import num_windows
from logvggt_jax.operations import count_flops

PARTS = ("encoder", "backbone", "dense head", "GCCR", "camera head")


@dataclasses.dataclass(frozen=True)
class Part:
    """A program that a sequence runs `calls` times."""

    name: str  # one of `PARTS`; several programs may have one name
    function: Callable[..., Any]  # of the variables and `arguments`
    arguments: tuple[Any, ...]  # abstract ones, `jax.ShapeDtypeStruct` and pytrees of them, with a batch of one
    calls: int  # in the whole sequence


@dataclasses.dataclass(frozen=True)
class PartTime:
    """Seconds of a part: to compile it, and of one call (median of the rounds).

    `temporary_bytes` is None where the compiler does not say.
    """

    name: str
    calls: int
    compilation: float
    median: float
    temporary_bytes: int | None


def sequence_parts(model: LogVGGT, num_frames: int, image_size: tuple[int, int]) -> list[Part]:
    """Everything that a sequence of `num_frames` frames of `image_size` (H, W) runs, as `LogVGGT.apply` does.

    The model's refinement decides what runs how often.
    """
    config = model.config
    stride, overlap = config.windows.stride, config.windows.size - config.windows.stride
    windows = num_windows(num_frames, config.windows.size, stride)
    variables = variable_shapes(model.config)

    def images(count: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((1, count, *image_size, 3), jnp.uint8)

    def mask(count: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((1, count), bool)

    state = jax.eval_shape(model.start, variables, images(overlap))
    window = jax.eval_shape(model.windows.encode, variables, images(config.windows.size))
    tokens = jax.eval_shape(model.windows.attend, variables, state, window)

    def dense(count: int, calls: int) -> Part:
        key, special = tokens
        key = jax.ShapeDtypeStruct((*key.shape[:2], count, *key.shape[3:]), key.dtype)
        special = jax.ShapeDtypeStruct((1, count, *special.shape[2:]), special.dtype)
        decode = functools.partial(model.windows.decode_dense, image_size=image_size)
        return Part("dense head", decode, (WindowTokens(key, special), mask(count)), calls)  # type: ignore[arg-type]

    parts = [
        Part("encoder", model.windows.encode, (images(overlap),), 1),
        Part("encoder", model.windows.encode, (images(stride),), windows),
        Part("backbone", model.windows.attend, (state, window), windows),
        dense(stride, windows),
        dense(overlap, 1),
    ]
    return parts + _refinement_parts(model, num_frames)


def _refinement_parts(model: LogVGGT, num_frames: int) -> list[Part]:
    """The halves of a trigger, as often as there are triggers, and the projection of the registers."""
    settings, width = model.config.refinement, 2 * model.config.encoder.embed_dim
    size = num_frames if settings.period is None else min(settings.period, num_frames)
    triggers = num_triggers(num_frames, size)
    # The last trigger has its full size, see `Refinement.fire_all`.
    count = triggers * size
    variables = variable_shapes(model.config)
    tokens = jax.ShapeDtypeStruct((1, count, width), jnp.float32)
    scalar, lengths = jax.ShapeDtypeStruct((), jnp.int32), jax.ShapeDtypeStruct((1,), jnp.int32)
    span = Span(scalar, scalar, lengths, lengths)  # type: ignore[arg-type]
    parts = []
    if settings.enabled:
        register_tokens = jax.ShapeDtypeStruct((1, count, model.config.aggregator.num_registers, width), jnp.float32)
        registers = jax.eval_shape(model.refinement.project_registers, variables, register_tokens)
        refine = functools.partial(model.refinement.refine_span, size=size)
        parts.append(Part("GCCR", model.refinement.project_registers, (register_tokens,), 1))
        parts.append(Part("GCCR", refine, (tokens, registers, tokens, span), triggers))
    decode = functools.partial(model.refinement.decode_span, size=size)
    return [*parts, Part("camera head", decode, (tokens, span), triggers)]


def flops_by_part(model: LogVGGT, num_frames: int, image_size: tuple[int, int]) -> dict[str, float]:
    """Operations of a whole sequence by part, a multiply-add counted as two; shapes alone, nothing is allocated.

    Attention is counted in its XLA form, of whose products the other kernels do no fewer.
    """
    model = LogVGGT(dataclasses.replace(model.config, attention="xla"))
    variables = variable_shapes(model.config)
    counts = dict.fromkeys(PARTS, 0.0)
    for part in sequence_parts(model, num_frames, image_size):
        counts[part.name] += part.calls * count_flops(part.function, variables, *part.arguments)
    return counts


def time_part(part: Part, variables: Any, *, rounds: int = 3, least_seconds: float = 0.2) -> PartTime:
    """Compiles a part and times `rounds` of as many calls as take `least_seconds`.

    `variables` are {"params": …} on the device.
    """
    # Values do not matter to the time, but masks have to let everything through.
    arguments = jax.tree.map(lambda x: jnp.ones(x.shape, x.dtype), part.arguments)
    started = time.perf_counter()
    program = jax.jit(part.function).lower(variables, *arguments).compile()
    compilation = time.perf_counter() - started
    jax.block_until_ready(program(variables, *arguments))
    seconds = []
    for _ in range(rounds):
        calls, started = 0, time.perf_counter()
        while calls == 0 or time.perf_counter() - started < least_seconds:
            jax.block_until_ready(program(variables, *arguments))
            calls += 1
        seconds.append((time.perf_counter() - started) / calls)
    memory = program.memory_analysis()
    return PartTime(
        name=part.name,
        calls=part.calls,
        compilation=compilation,
        median=statistics.median(seconds),
        temporary_bytes=None if memory is None else int(memory.temp_size_in_bytes),
    )


def live_device_bytes() -> int:
    """Bytes of all arrays alive now, temporaries of running programs aside."""
    return sum(array.nbytes for array in jax.live_arrays())


def peak_host_bytes() -> int:
    """Most physical memory that this process has had so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def spread(values: Sequence[float]) -> str:
    """Median and extremes as text."""
    return f"{statistics.median(values):.3f} ({min(values):.3f} to {max(values):.3f})"
