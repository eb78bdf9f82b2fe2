"""Forms of attention side by side on this machine: time, achieved GFLOP/s, compiled temporaries, and the ratio.

    python benchmarks/attention.py

The forms take turns, so that a noisy machine slows all of them; the median of the rounds counts.
"""

from __future__ import annotations

import argparse
import statistics
import time

import jax
import jax.numpy as jnp

from logvggt_jax.model import attention as module


def einsum(query: jax.Array, key: jax.Array, value: jax.Array) -> jax.Array:
    """The textbook, all scores at once."""
    scores = jnp.einsum("bqhd,bkhd->bhqk", query, key, preferred_element_type=jnp.float32)
    weights = jax.nn.softmax(scores * query.shape[-1] ** -0.5, axis=-1)
    return jnp.einsum("bhqk,bkhd->bqhd", weights.astype(value.dtype), value)


FORMS = {
    "ours": module.attention,
    "einsum": einsum,
    "jax.nn.dot_product_attention": jax.nn.dot_product_attention,
}


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tokens", type=int, default=1374, help="tokens of one frame (518x518: 1374)")
    parser.add_argument("--frames", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    shape = (1, options.tokens * options.frames, 16, 64)
    inputs = [jax.random.normal(jax.random.key(i), shape) for i in range(3)]
    flops = 4 * shape[1] ** 2 * shape[2] * shape[3]
    programs = {name: jax.jit(form).lower(*inputs).compile() for name, form in FORMS.items()}
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    for program in programs.values():
        jax.block_until_ready(program(*inputs))
    for _ in range(options.rounds):
        for name, program in programs.items():
            started = time.perf_counter()
            jax.block_until_ready(program(*inputs))
            seconds[name].append(time.perf_counter() - started)
    print(f"{jax.devices()[0].device_kind}, {shape[1]} tokens, 16 heads of 64, float32, median of {options.rounds}")
    fastest = statistics.median(seconds["ours"])
    for name, program in programs.items():
        median = statistics.median(seconds[name])
        memory = program.memory_analysis().temp_size_in_bytes / 2**20
        print(
            f"{name:30s} {median * 1e3:8.1f} ms {flops / median / 1e9:7.1f} GFLOP/s {memory:8.1f} MiB "
            f"{median / fastest:5.2f} x ours"
        )


if __name__ == "__main__":
    main()
