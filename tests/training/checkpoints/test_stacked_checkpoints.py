"""Checkpoints of earlier versions, in which layers stood by themselves: all of them, or those of the trunk."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest

from logvggt_jax.model.parameters import stack_layers
from logvggt_jax.training.checkpoints.checkpoint_files import Position
from logvggt_jax.training.checkpoints.run_checkpoints import RunCheckpoints
from logvggt_jax.training.config import OptimizerConfig, TrainConfig
from logvggt_jax.training.step.optimizer import make_optimizer
from logvggt_jax.training.step.state import TrainState, initial_state
from logvggt_jax.weights.checkpoints import digests


@pytest.mark.parametrize("blocks", ["apart", "stacked"])
def test_a_checkpoint_layer_by_layer_is_taken_up_as_stacks(
    blocks: str, run_config: TrainConfig, optimizer_config: OptimizerConfig, tmp_path: Path
) -> None:
    generator = np.random.default_rng(0)
    depth = run_config.model.camera_head.depth

    def layer() -> dict[str, np.ndarray]:
        return {"kernel": generator.standard_normal((3, 4)).astype(np.float32)}

    params = {
        "encoder": {"block_0": layer(), "norm": layer()},
        "aggregator": {f"{kind}_block_{i}": layer() for kind in ("frame", "global") for i in range(4)},
        "camera_head": {"trunk_norm": layer(), **{f"trunk_{i}": layer() for i in range(depth)}},
    }
    if blocks == "stacked":
        params |= {part: stack_layers(params[part]) for part in ("encoder", "aggregator")}
    optimizer = make_optimizer(optimizer_config, params, frozen=("encoder/*",))
    state = initial_state(params, optimizer)
    state = jax.tree.map(lambda x: x + generator.standard_normal(x.shape).astype(x.dtype), state)
    rest = {name: value for name, value in state._asdict().items() if name not in ("params", "average")}
    meta = {
        "step": 7,
        "stage": 1,
        "config": run_config.to_dict(),
        "digests": {"params": digests(state.params), "state": digests(rest)},
        "libraries": {},
        **({"layers": "stacked"} if blocks == "stacked" else {}),
    }
    # They were written by Orbax's manager, with files of its own beside ours.
    with ocp.CheckpointManager(tmp_path / "checkpoints") as manager:
        manager.save(
            7,
            args=ocp.args.Composite(
                params=ocp.args.StandardSave(state.params),
                state=ocp.args.StandardSave(rest),
                data=ocp.args.JsonSave({}),
                meta=ocp.args.JsonSave(meta),
            ),
        )
    wanted: TrainState = stack_layers(state)
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=here), wanted)
    with RunCheckpoints(tmp_path, run_config) as checkpoints:
        restored, position = checkpoints.restore(like)
    assert position == Position(1, {})
    assert restored.params["aggregator"]["global_blocks"]["kernel"].shape == (4, 3, 4)
    assert restored.params["camera_head"]["trunk"]["kernel"].shape == (depth, 3, 4)
    jax.tree.map(np.testing.assert_array_equal, restored, wanted)
