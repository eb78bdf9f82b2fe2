"""Lowers and compiles the 1B inference step for this machine's CPU, described TPUs and GPUs, or CUDA (lowering only).

    python benchmarks/compile_step.py --target cpu
    python benchmarks/compile_step.py --target v5e:2x2x1 --target v5p:2x2x1
    python benchmarks/compile_step.py --target h100
    python benchmarks/compile_step.py --target h100 --loops
    python benchmarks/compile_step.py --target cuda --masks
    python benchmarks/compile_step.py --target h100 --train 4x12

Described devices need their compiler and not themselves, see `logvggt_jax/described.py`: it runs on the CPU for one of
them, and the memory figures are its own. Kernels are counted, with the bytes of what they read and write. `cuda` needs
nothing: the program is lowered with a stand-in for JAX's check of the installed cuDNN, and nothing of it is compiled.
Seconds are a processor's, those of XLA's threads and of the `ptxas` that it runs among them: other work on the machine
changes them little. With `--loops` layers run as loops, as training has them.
`--train` compiles the training step of `configs/h20.py` instead, for so many clips of so many frames and a described
device.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import itertools
import os
import re
import resource
from typing import Any, NamedTuple

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from kernels import different_fusions, kernels

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.described import attention_kernels, cudnn_by_description, described_devices
from logvggt_jax.doctor.training import h20_step
from logvggt_jax.model.initialization import variable_shapes
from logvggt_jax.model.parameters import in_compute_type, stack_layers
from logvggt_jax.training.parallel.sharding import DATA_AXIS, replicated, split
from logvggt_jax.training.step.costs import abstract_clips
from logvggt_jax.training.step.state import initial_state

IMAGE_SIZE = (392, 518)
GIB = 2**30


def abstract_step(
    model: LogVGGT, masked: bool, loops: bool = False, sharding: jax.sharding.Sharding | None = None
) -> tuple:
    """Abstract arguments (variables, state, frames, frame_mask, masks) of one step with a batch of one, its layers one
    by one or as loops."""
    windows = model.config.windows

    def frames(count: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((1, count, *IMAGE_SIZE, 3), jnp.uint8)

    def masks(count: int) -> jax.ShapeDtypeStruct | None:
        return jax.ShapeDtypeStruct((1, count, *IMAGE_SIZE), bool) if masked else None

    variables = jax.eval_shape(lambda given: in_compute_type(given, model.config), variable_shapes(model.config))
    variables = jax.eval_shape(stack_layers, variables) if loops else variables
    overlap = windows.size - windows.stride
    state = jax.eval_shape(model.start, variables, frames(overlap), None, masks(overlap))
    mask = jax.ShapeDtypeStruct((1, windows.stride), bool)
    return _placed((variables, state, frames(windows.stride), mask, masks(windows.stride)), sharding)


class Made(NamedTuple):
    """A compiled program, and the processor seconds in which it was traced, lowered and compiled."""

    program: jax.stages.Compiled
    seconds: tuple[float, ...]


def made(step: Any, *arguments: Any) -> Made:
    """Compiles a function of `jax.jit`."""
    clock = [_processor_seconds()]

    def timed(result: Any) -> Any:
        clock.append(_processor_seconds())
        return result

    program = timed(timed(timed(step.trace(*arguments)).lower()).compile())
    return Made(program, tuple(end - begin for begin, end in itertools.pairwise(clock)))


def _processor_seconds() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def compile_step(config: ModelConfig, masked: bool, loops: bool, name: str) -> Made:
    """The step for this machine's CPU or for one of the devices that `described_devices` knows by `name`, with the
    attention that it would have; the parameters are those of a stream."""
    device = jax.devices()[0] if name == "cpu" else described_devices(name)[0]
    sharding = None if name == "cpu" else jax.sharding.SingleDeviceSharding(device)
    with attention_kernels(device) as attention:
        model = LogVGGT(dataclasses.replace(config, attention=attention))
        return made(jax.jit(model.step, donate_argnums=1), *abstract_step(model, masked, loops, sharding))


def compile_training(config: ModelConfig, name: str, clips: int, frames: int) -> Made:
    """The training step that `logvggt doctor` examines, for one of the devices that `described_devices` knows."""
    device = described_devices(name)[0]
    mesh = Mesh(np.array([device]), (DATA_AXIS,))
    with attention_kernels(device) as attention:
        model = LogVGGT(dataclasses.replace(config, attention=attention))
        params = jax.eval_shape(stack_layers, variable_shapes(model.config)["params"])
        step, optimizer = h20_step(model, params, mesh)
        state = jax.eval_shape(lambda params: initial_state(params, optimizer), params)
        arguments = (state, replicated(mesh)), (abstract_clips(clips, frames, IMAGE_SIZE), split(mesh))
        return made(step, *(_placed(tree, sharding) for tree, sharding in arguments))


def _placed(tree: Any, sharding: jax.sharding.Sharding) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree)


def lower_for_cuda(config: ModelConfig, masked: bool, loops: bool) -> str:
    """The step's StableHLO for CUDA with cuDNN attention, lowered with a stand-in for the cuDNN version check."""
    with cudnn_by_description():
        model = LogVGGT(dataclasses.replace(config, attention="cudnn"))
        step = jax.jit(model.step, donate_argnums=1)
        return step.trace(*abstract_step(model, masked, loops)).lower(lowering_platforms=("cuda",)).as_text()


def count_calls(program: str, kernel: str) -> int:
    """Calls of a kernel in StableHLO whose functions call one another, each as often as it is called from `main`."""
    functions = dict(re.findall(r"func\.func \w+ @(\w+)(.*?)(?=func\.func|\Z)", program, re.DOTALL))

    @functools.cache
    def within(name: str) -> int:
        body = functions[name]
        return body.count(kernel) + sum(
            within(called) for called in re.findall(r"call @(\w+)\(", body) if called in functions
        )

    return within("main")


def describe_memory(compiled: jax.stages.Compiled) -> str:
    """The compiler's own figures."""
    memory = compiled.memory_analysis()
    return (
        f"arguments {memory.argument_size_in_bytes / GIB:.2f} GiB (of them donated "
        f"{memory.alias_size_in_bytes / GIB:.3f}), outputs {memory.output_size_in_bytes / GIB:.3f} GiB, "
        f"temporaries {memory.temp_size_in_bytes / GIB:.2f} GiB"
    )


def describe_kernels(compiled: jax.stages.Compiled) -> str:
    """How many of each kind, and what they move; where the compiler counts that itself, which it does for TPUs and
    whose programs hold what are no kernels, what it says, and those of attention."""
    found = kernels(compiled.as_text() or "")
    if moved := (compiled.cost_analysis() or {}).get("bytes accessed"):
        return f"{found['attention'].count} attention, {moved / 1e9:.2f} GB accessed in all"
    counts = ", ".join(f"{each.count} {kind} ({each.size / 1e9:.2f} GB)" for kind, each in found.items())
    return f"{counts}; {different_fusions(compiled.as_text() or '')} different fusions"


def main() -> None:
    """Prints a line or two for every target."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", action="append", help="cpu, cuda, v5p:2x2x1, h100, …; default cpu")
    parser.add_argument("--dtype", default="bfloat16")
    parser.add_argument("--masks", action="store_true", help="a step of a stream with masks of pixels")
    parser.add_argument("--loops", action="store_true", help="layers as loops, which training has anyway")
    parser.add_argument("--train", metavar="CLIPSxFRAMES", help="the training step, for described devices")
    options = parser.parse_args()
    targets = options.target or ["cpu"]
    if options.train and (options.masks or options.loops or {"cpu", "cuda"} & set(targets)):
        parser.error("--train is for described devices, such as --target h100, has no masks and its layers as loops")
    config = ModelConfig(dtype=options.dtype)
    what = f"training step, clips {options.train} of" if options.train else "one step of 2 new frames"
    print(f"VGGT-1B sizes, {what} {IMAGE_SIZE[0]}x{IMAGE_SIZE[1]}, {options.dtype}")
    for target in targets:
        if target == "cuda":
            text = lower_for_cuda(config, options.masks, options.loops)
            calls = count_calls(text, "__cudnn$fmha")
            print(f"cuda: lowered, {calls} calls of cuDNN attention (not compiled, not run)")
            continue
        if options.train:
            clips, frames = (int(number) for number in options.train.split("x"))
            compiled, seconds = compile_training(config, target, clips, frames)
        else:
            compiled, seconds = compile_step(config, options.masks, options.loops, target)
        took = "traced in {:.1f} s, lowered in {:.1f} s, compiled in {:.1f} s".format(*seconds)
        described = "" if target == "cpu" else f"; {describe_kernels(compiled)}"
        print(f"{target}: {took}; {describe_memory(compiled)}{described}")


if __name__ == "__main__":
    main()
