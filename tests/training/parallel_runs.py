"""The same steps of the same clips on any number of devices and processes, to be compared.

Started as a script this is one of several processes: FILE NUMBER PROCESSES ADDRESS.
"""

from __future__ import annotations

import dataclasses
import pickle
import re
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from logvggt_jax import LogVGGT, ModelConfig, Predictions
from logvggt_jax.model.parameters import is_stack, whole
from logvggt_jax.training.config import LossConfig, TrainConfig
from logvggt_jax.training.parallel.sharding import Layout, data_mesh, parameter_layout, put_batch
from logvggt_jax.training.step.program import make_program
from logvggt_jax.training.step.train_step import loss_and_gradients, make_loss_terms
from logvggt_jax.weights.digests import whole_array

Clips = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class LayeredModel:
    """A loop over stacked layers before the pixels' model, which compiles at once; the interface of `LogVGGT`."""

    config: ModelConfig
    pixels: Any

    def apply(
        self, variables: Any, images: jax.Array, frame_mask: jax.Array | None = None, *, remat: bool = False
    ) -> Predictions:
        params = whole(variables["params"])

        @jax.checkpoint
        def layer(x: jax.Array, one: Any) -> tuple[jax.Array, None]:
            one = whole(one)
            return x + jnp.tanh(x @ one["kernel"] + one["bias"]), None

        x = images.astype(jnp.float32) @ params["aggregator"]["embed"]["kernel"] / 255.0
        x, _ = jax.lax.scan(layer, x, params["aggregator"]["frame_blocks"])
        heads = {name: params[name] for name in ("depth_head", "camera_head")}
        return self.pixels.apply({"params": heads}, 255.0 * x[..., :3], frame_mask)


class Outcome(NamedTuple):
    """The gradient of the first step and the parameters after the last one, on the host, the loss of every step, and
    the step's program as the compiler tells it."""

    gradient: Any
    losses: list[float]
    params: Any
    program: str


def first_gradient(
    model: Any,
    config: LossConfig,
    params: Any,
    clips: Clips,
    mesh: Mesh,
    *,
    shard: bool = False,
    accumulate: int = 1,
    frozen: tuple[str, ...] = (),
) -> Any:
    """Loss, what is logged, the gradient and its norm, on the host."""
    terms = make_loss_terms(model, config, frozen=frozen)
    layout = parameter_layout(params, mesh, shard=shard)
    specs = layout.specs(params)

    def run(params: Any, batch: Any) -> Any:
        total, metrics, found, _ = loss_and_gradients(terms, config, params, batch, layout, accumulate=accumulate)
        return total, metrics, found, layout.norm(found)

    sharded = jax.shard_map(
        run, mesh=mesh, in_specs=(specs, P("data")), out_specs=(P(), P(), specs, P()), check_vma=False
    )
    return jax.device_get(jax.jit(sharded)(layout.put(params), put_batch(clips, mesh)))


def steps(model: Any, config: TrainConfig, params: Any, clips: Clips, mesh: Mesh, count: int) -> Outcome:
    """`count` steps on this process's share of `clips`. The configuration's clipping must not be felt."""
    program = make_program(model, config, jax.eval_shape(lambda: params), mesh)
    state, batch = program.initial_state(params), put_batch(clips, mesh)
    step = program.step.lower(state, batch).compile()
    gradient, losses = None, []
    for _ in range(count):
        state, metrics, _ = step(state, batch)
        losses.append(float(metrics["loss/total"]))
        if gradient is None:
            # Adam's first moment is the gradient, but for a factor. Each module has an Adam of its own, whose tree is
            # empty where the other modules are.
            adams = [x for x in jax.tree.leaves(state.opt_state, is_leaf=_is_adam) if _is_adam(x)]
            moments = {name: tree for adam in adams for name, tree in adam.mu.items() if jax.tree.leaves(tree)}
            gradient = jax.tree.map(lambda x: np.asarray(whole_array(x)) / (1 - config.optimizer.b1), moments)
    params = jax.tree.map(lambda x: np.asarray(whole_array(x)), state.params)
    return Outcome(gradient, losses, params, step.as_text() or "")


def exchanged(program: str, kind: str) -> set[tuple[int, ...]]:
    """Shapes of the arrays that exchanges of this `kind` (`all-gather`, …) of a compiled program give a device."""
    results = re.findall(rf" = (.*?) {kind}(?:-done)?\(", program)
    return {
        tuple(int(side) for side in shape.split(",") if side)
        for result in results
        for shape in re.findall(r"\[([\d,]*)\]", result)
    }


def layers_in_parts(params: Any, layout: Layout) -> tuple[set[tuple[int, ...]], set[tuple[int, ...]]]:
    """Shapes of the parameters that are split, whole and as a device has them; of a stack those of one layer."""
    found: tuple[set[tuple[int, ...]], set[tuple[int, ...]]] = (set(), set())
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        names = tuple(str(entry.key) for entry in path)
        if names in layout.axes:
            shape = list(leaf.shape[1:] if any(map(is_stack, names)) else leaf.shape)
            found[0].add(tuple(shape))
            shape[layout.axes[names]] //= layout.mesh.size
            found[1].add(tuple(shape))
    return found


def _is_adam(state: Any) -> bool:
    return isinstance(state, optax.ScaleByAdamState)


def steps_of_processes(
    configs: Sequence[TrainConfig],
    params: Any,
    clips: Clips,
    count: int,
    folder: Path,
    *,
    layered: bool,
    processes: int = 2,
) -> list[Outcome]:
    """`steps` of each configuration by real processes with two devices each, as the first one sees them."""
    given = folder / "given.pickle"
    given.write_bytes(pickle.dumps(([config.to_dict() for config in configs], params, clips, count, layered)))
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        address = f"localhost:{probe.getsockname()[1]}"
    started = [
        subprocess.Popen(
            [sys.executable, __file__, str(given), str(number), str(processes), address],
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        for number in range(processes)
    ]
    outputs = [process.communicate(timeout=1200)[0] for process in started]
    assert [process.returncode for process in started] == [0] * processes, outputs
    return [Outcome(*each) for each in pickle.loads((folder / "outcomes.pickle").read_bytes())]


def _main(given: Path, number: int, processes: int, address: str) -> None:
    from conftest import PixelModel

    jax.config.update("jax_num_cpu_devices", 2)
    jax.distributed.initialize(address, processes, number)
    settings, params, clips, count, layered = pickle.loads(given.read_bytes())
    share = len(clips["images"]) // processes
    own = {name: value[number * share : (number + 1) * share] for name, value in clips.items()}
    outcomes = []
    for config in map(TrainConfig.from_dict, settings):
        model = LayeredModel(config.model, PixelModel(config.model)) if layered else LogVGGT(config.model)
        outcomes.append(tuple(steps(model, config, params, own, data_mesh(), count)))
    if number == 0:
        (given.parent / "outcomes.pickle").write_bytes(pickle.dumps(outcomes))


if __name__ == "__main__":
    _main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])
