"""The full-size inference step as a program for accelerators, compiled or lowered without having them.

The compilers run in processes of their own: JAX in this one is tied to the CPU, at a low level of optimisation.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from kernels import different_fusions, kernels

from logvggt_jax.described import gpu_compiler_installed

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "compile_step.py"
# Encoder, frame and global blocks of VGGT-1B: one attention each.
ATTENTIONS = 3 * 24
GIB = 2**30


def described(target: str, *options: str) -> str:
    """What the script prints of one target; shown with the test's report."""
    own = ("XLA_FLAGS", "JAX_PLATFORMS", "JAX_NUM_CPU_DEVICES")
    environment = {name: value for name, value in os.environ.items() if name not in own}
    finished = subprocess.run(
        [sys.executable, str(SCRIPT), "--target", target, *options],
        capture_output=True,
        text=True,
        timeout=1200,
        check=False,
        env=environment,
    )
    assert finished.returncode == 0, finished.stderr[-3000:]
    print(finished.stdout)
    (line,) = [line for line in finished.stdout.splitlines() if line.startswith(f"{target}:")]
    return line


def figure(pattern: str, line: str) -> float:
    found = re.search(pattern, line)
    assert found is not None, line
    return float(found[1])


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("libtpu") is None, reason='needs the TPU compiler: pip install "libtpu"')
@pytest.mark.parametrize(("topology", "memory"), [("v5e:2x2x1", 16e9), ("v5p:2x2x1", 95e9)])
def test_compiles_for_a_described_tpu_with_the_flash_kernel(topology: str, memory: float) -> None:
    line = described(topology)
    assert figure(r"(\d+) attention", line) >= ATTENTIONS
    arguments = figure(r"arguments ([\d.]+) GiB", line) * GIB
    temporaries = figure(r"temporaries ([\d.]+) GiB", line) * GIB
    assert arguments > 1.85e9, "what the step reads: encoder, aggregator and depth head, 0.94 billion in bfloat16"
    assert temporaries > 0
    assert arguments + temporaries < memory


@pytest.mark.slow
@pytest.mark.skipif(not gpu_compiler_installed(), reason="needs the compiler that JAX for CUDA brings, and no GPU")
def test_compiles_for_a_described_gpu_with_few_kernels() -> None:
    line = described("h100")
    assert figure(r"(\d+) attention", line) == ATTENTIONS
    # 846 kernels that moved 25 GB, before sums left products in 16 bits.
    assert figure(r"(\d+) others", line) < 720
    assert figure(r"others \(([\d.]+) GB\)", line) < 18.0


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--masks",)])
def test_lowers_for_cuda_with_cudnn_attention(options: tuple[str, ...]) -> None:
    """Also where masks say which keys count."""
    line = described("cuda", *options)
    assert figure(r"(\d+) calls of cuDNN attention", line) >= ATTENTIONS


@pytest.mark.slow
def test_lowers_and_compiles_for_a_cpu_within_a_minute() -> None:
    line = described("cpu")
    assert figure(r"lowered in ([\d.]+) s", line) + figure(r"compiled in ([\d.]+) s", line) < 60


@pytest.mark.parametrize(
    "options", [(), ("--target", "cuda"), ("--target", "h100", "--masks"), ("--target", "h100", "--loops")]
)
def test_a_training_step_is_not_announced_where_another_would_be_compiled(
    options: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")  # which the script sets where nothing does
    monkeypatch.setattr(sys, "argv", ["compile_step.py", "--train", "4x12", *options])
    with pytest.raises(SystemExit):
        importlib.import_module("compile_step").main()
    assert "--train is for described devices" in capsys.readouterr().err


def test_kernels_are_counted_as_often_as_they_run() -> None:
    def step(carried: tuple[jax.Array, ...], dear: jax.Array) -> tuple[tuple[jax.Array, ...], None]:
        last = jax.lax.cond(dear, lambda x: jnp.sin(x @ x), jnp.sin, carried[-1])
        return (*(jnp.sin(x @ x) for x in carried[:-1]), last), None

    factors = tuple(jnp.eye(64) * (1 + i) for i in range(6))
    which = jnp.arange(5) == 2
    program = jax.jit(lambda x: jax.lax.scan(step, x, which)[0]).lower(factors).compile().as_text()
    assert "/*index=5*/" in program, "a tuple so wide that XLA numbers it"
    found = kernels(program)
    assert found["products"].count == 6 * 5, "a condition as its dearest branch"
    # Two operands, which are one array, and the result.
    assert found["products"].size >= 6 * 5 * 2 * 4 * 64 * 64
    assert found["attention"] == (0, 0) == found["convolutions"]
    wide = ", ".join("f32[4]" for _ in range(6))
    text = f"ENTRY %main (x: f32[4]) -> ({wide}) {{\n  %x = f32[4] parameter(0)\n  ROOT %y = ({wide}) fusion(%x)\n}}\n"
    assert kernels(text)["others"] == (1, 7 * 16)
    with pytest.raises(ValueError, match="not an instruction"):
        kernels(text.replace("fusion(%x)", "fusion"))


def test_equal_fusions_are_counted_once() -> None:
    def fused(name: str, operation: str, remark: str) -> str:
        return (
            f"%{name} (x.{name}: f32[4]) -> f32[4] {{\n  %x.{name} = f32[4] parameter(0)\n"
            f'  ROOT %y.{name} = f32[4] {operation}(%x.{name}), metadata={{op_name="{remark}"}}\n}}\n\n'
        )

    computations = ("a", "negate", "layer 0"), ("b", "negate", "layer 1"), ("c", "sine", "layer 1")
    calls = "".join(f"  %z.{name} = f32[4] fusion(%x), kind=kLoop, calls=%{name}\n" for name, *_ in computations)
    entry = f"ENTRY %main (x: f32[4]) -> f32[4] {{\n  %x = f32[4] parameter(0)\n{calls}}}\n"
    assert different_fusions("".join(fused(*each) for each in computations) + entry) == 2
