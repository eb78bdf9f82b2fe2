"""What a checkpoint costs a training run: how long the steps wait, and what is done beside them.

    python benchmarks/save_checkpoint.py --folder /scratch --step_seconds 2.0

Saves the state of a model whose parameters and two moments have about `--megabytes`, a few times, as training does:
with digests, the model folder beside it, and that kept as the best model, which a validation may find it. The steps
wait while the state is copied to the host; the rest happens in a thread. `--step_seconds` is what a step of the run in
question takes, of which an epoch has 800 (`configs/h20.py`).
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from subject import tiny_configuration

from logvggt_jax import LogVGGT
from logvggt_jax.training.checkpoints.checkpoint_files import Position
from logvggt_jax.training.checkpoints.run_checkpoints import RunCheckpoints
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.sharding import data_mesh
from logvggt_jax.training.step.program import abstract_parameters, make_program

STEPS_AN_EPOCH = 800
GOAL = 0.02
# Heads of 56 channels; parameters grow with the square of the width.
_WIDTHS = range(56, 2241, 56)


def sized_config(megabytes: float) -> TrainConfig:
    """`configs/tiny.py` with the widest model whose parameters and two moments have at most so many megabytes."""
    config = TrainConfig.from_dict(tiny_configuration())
    chosen = config
    for width in _WIDTHS:
        model = dataclasses.replace(
            config.model,
            encoder=dataclasses.replace(config.model.encoder, embed_dim=width, num_heads=width // 56),
            aggregator=dataclasses.replace(config.model.aggregator, depth=8, num_heads=width // 56),
            camera_head=dataclasses.replace(config.model.camera_head, num_heads=width // 56),
            refinement=dataclasses.replace(config.model.refinement, num_heads=width // 56),
        )
        size = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(abstract_parameters(model)))
        if 12 * size > megabytes * 1e6:
            break
        chosen = dataclasses.replace(config, model=model)
    return chosen


def main() -> None:
    """Prints the median of the saves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=500.0, help="of parameters and moments")
    parser.add_argument("--saves", type=int, default=3)
    parser.add_argument("--step_seconds", type=float, default=1.0, help="of the run in question")
    parser.add_argument("--folder", type=Path, default=None, help="on the disk in question; default: the temporary one")
    options = parser.parse_args()
    config, mesh = sized_config(options.megabytes), data_mesh()
    shapes = abstract_parameters(config.model)
    generator = np.random.default_rng(0)
    params = jax.tree.map(lambda leaf: generator.standard_normal(leaf.shape, np.float32), shapes)
    state = make_program(LogVGGT(config.model), config, shapes, mesh).initial_state(params)
    del params  # a training run does not keep them either
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    waited, finished, processor = [], [], []
    with (
        tempfile.TemporaryDirectory(dir=options.folder) as folder,
        RunCheckpoints(Path(folder) / "run", config) as checkpoints,
    ):
        for number in range(options.saves):
            begun, used = time.perf_counter(), time.process_time()
            saved = state._replace(step=state.step + number)
            checkpoints.save(saved, Position(0, {}))
            checkpoints.save_best(saved)
            waited.append(time.perf_counter() - begun)
            own = time.process_time() - used
            checkpoints.wait()
            finished.append(time.perf_counter() - begun)
            processor.append(time.process_time() - used - own)
    wait, end, work = (float(np.median(values)) for values in (waited, finished, processor))
    epoch = STEPS_AN_EPOCH * options.step_seconds
    print(f"state of {size / 1e6:.0f} MB on {mesh.size} x {jax.devices()[0].device_kind}")
    print(f"steps wait {wait:.2f} s for a save ({size / 1e9 / wait:.2f} GB/s)")
    print(f"it is on the disk after {end:.2f} s, with {work:.2f} s of a processor beside the steps")
    met = "yes" if (wait + work) / epoch < GOAL else "no"
    print(
        f"of an epoch of {STEPS_AN_EPOCH} steps of {options.step_seconds:g} s that is {wait / epoch:.2%} of waiting, "
        f"{work / epoch:.2%} of a core (together below {GOAL:.0%}: {met})"
    )


if __name__ == "__main__":
    main()
