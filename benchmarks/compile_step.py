"""Lowers and compiles the 1B inference step for this machine's CPU, described TPUs and GPUs, or CUDA (lowering only).

    python benchmarks/compile_step.py --target cpu
    python benchmarks/compile_step.py --target v5e:2x2x1 --target v5p:2x2x1
    python benchmarks/compile_step.py --target h100
    python benchmarks/compile_step.py --target cuda --masks
    python benchmarks/compile_step.py --target h100 --train 4x12

Described devices need their compiler and not themselves, see `logvggt_jax/described.py`: it runs on the CPU for one of
them, and the memory figures are its own. Kernels are counted, with the bytes of what they read and write. `cuda` needs
nothing: the program is lowered with a stand-in for JAX's check of the installed cuDNN, and nothing of it is compiled.
`--train` compiles the training step of `configs/h20.py` instead, for so many clips of so many frames and a described
device.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import re
import time
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from kernels import kernels

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


def abstract_step(model: LogVGGT, masked: bool, sharding: jax.sharding.Sharding | None = None) -> tuple:
    """Abstract arguments (variables, state, frames, frame_mask, masks) of one step with a batch of one."""
    windows = model.config.windows

    def frames(count: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((1, count, *IMAGE_SIZE, 3), jnp.uint8)

    def masks(count: int) -> jax.ShapeDtypeStruct | None:
        return jax.ShapeDtypeStruct((1, count, *IMAGE_SIZE), bool) if masked else None

    variables = jax.eval_shape(lambda given: in_compute_type(given, model.config), variable_shapes(model.config))
    overlap = windows.size - windows.stride
    state = jax.eval_shape(model.start, variables, frames(overlap), None, masks(overlap))
    mask = jax.ShapeDtypeStruct((1, windows.stride), bool)
    return _placed((variables, state, frames(windows.stride), mask, masks(windows.stride)), sharding)


def compile_for_cpu(config: ModelConfig, masked: bool) -> tuple[float, float, jax.stages.Compiled]:
    """Seconds to lower, seconds to compile, and the program."""
    model = LogVGGT(config)
    arguments = abstract_step(model, masked)
    started = time.perf_counter()
    lowered = jax.jit(model.step, donate_argnums=1).lower(*arguments)
    lowered_at = time.perf_counter()
    compiled = lowered.compile()
    return lowered_at - started, time.perf_counter() - lowered_at, compiled


def compile_for_described(config: ModelConfig, masked: bool, name: str) -> jax.stages.Compiled:
    """The step for one of the devices that `described_devices` knows by `name`, with the attention that it would have;
    the parameters are those of a stream."""
    device = described_devices(name)[0]
    with attention_kernels(device) as attention:
        model = LogVGGT(dataclasses.replace(config, attention=attention))
        step = jax.jit(model.step, donate_argnums=1)
        return step.lower(*abstract_step(model, masked, jax.sharding.SingleDeviceSharding(device))).compile()


def compile_training(config: ModelConfig, name: str, clips: int, frames: int) -> jax.stages.Compiled:
    """The training step that `logvggt doctor` examines, for one of the devices that `described_devices` knows."""
    device = described_devices(name)[0]
    mesh = Mesh(np.array([device]), (DATA_AXIS,))
    with attention_kernels(device) as attention:
        model = LogVGGT(dataclasses.replace(config, attention=attention))
        params = jax.eval_shape(stack_layers, variable_shapes(model.config)["params"])
        step, optimizer = h20_step(model, params, mesh)
        state = jax.eval_shape(lambda params: initial_state(params, optimizer), params)
        arguments = (state, replicated(mesh)), (abstract_clips(clips, frames, IMAGE_SIZE), split(mesh))
        return step.lower(*(_placed(tree, sharding) for tree, sharding in arguments)).compile()


def _placed(tree: Any, sharding: jax.sharding.Sharding) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree)


def lower_for_cuda(config: ModelConfig, masked: bool) -> str:
    """The step's StableHLO for CUDA with cuDNN attention, lowered with a stand-in for the cuDNN version check."""
    with cudnn_by_description():
        model = LogVGGT(dataclasses.replace(config, attention="cudnn"))
        step = jax.jit(model.step, donate_argnums=1)
        return step.trace(*abstract_step(model, masked)).lower(lowering_platforms=("cuda",)).as_text()


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
    return ", ".join(f"{each.count} {kind} ({each.size / 1e9:.2f} GB)" for kind, each in found.items())


def main() -> None:
    """Prints a line or two for every target."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", action="append", help="cpu, cuda, v5p:2x2x1, h100, …; default cpu")
    parser.add_argument("--dtype", default="bfloat16")
    parser.add_argument("--masks", action="store_true", help="a step of a stream with masks of pixels")
    parser.add_argument("--train", metavar="CLIPSxFRAMES", help="the training step, for described devices")
    options = parser.parse_args()
    targets = options.target or ["cpu"]
    if options.train and (options.masks or {"cpu", "cuda"} & set(targets)):
        parser.error("--train is for described devices, such as --target h100, and has no masks")
    config = ModelConfig(dtype=options.dtype)
    what = f"training step, clips {options.train} of" if options.train else "one step of 2 new frames"
    print(f"VGGT-1B sizes, {what} {IMAGE_SIZE[0]}x{IMAGE_SIZE[1]}, {options.dtype}")
    for target in targets:
        if target == "cpu":
            lowering, compilation, compiled = compile_for_cpu(config, options.masks)
            print(f"cpu: lowered in {lowering:.1f} s, compiled in {compilation:.1f} s; {describe_memory(compiled)}")
        elif target == "cuda":
            text = lower_for_cuda(config, options.masks)
            calls = count_calls(text, "__cudnn$fmha")
            print(f"cuda: lowered, {calls} calls of cuDNN attention (not compiled, not run)")
        else:
            started = time.perf_counter()
            if options.train:
                clips, frames = (int(number) for number in options.train.split("x"))
                compiled = compile_training(config, target, clips, frames)
            else:
                compiled = compile_for_described(config, options.masks, target)
            seconds = time.perf_counter() - started
            print(f"{target}: compiled in {seconds:.0f} s; {describe_memory(compiled)}; {describe_kernels(compiled)}")


if __name__ == "__main__":
    main()
