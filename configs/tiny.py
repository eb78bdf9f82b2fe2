"""A tiny LoG-VGGT from nothing on procedural rooms: half an hour on two CPU cores.

    python train.py --config=configs/tiny.py --workdir=runs/tiny

Any field can be changed on the command line, for example --config.optimizer.learning_rate=5e-4, or left out with None
where it may be (--config.validation.best=None). The curriculum goes from single windows of 4 frames to clips of 12.
Depth is learned within minutes; rotation stays at the identity for the first two thousand steps.
"""

import math
import zlib

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder

from logvggt_jax.training.config_fields import with_all_fields
from logvggt_jax.weights.address import resolve
from logvggt_jax.weights.checkpoints import read_digests

HEIGHT, WIDTH = 56, 70
# Focal lengths of `compass` rooms in units of the image width, and their middle.
FOCAL_RANGE = (0.55, 0.75)
FOCAL = sum(FOCAL_RANGE) / 2


def initial_pose(height: int, width: int) -> tuple[float, ...]:
    """No motion, the mean field of view of the rooms: what is right before anything is learned."""
    return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2 * math.atan(height / width / 2 / FOCAL), 2 * math.atan(1 / 2 / FOCAL))


def get_config() -> ConfigDict:
    """The run; fields as `logvggt_jax.training.config.TrainConfig` and `ModelConfig` document them."""
    config = ConfigDict()
    config.seed = 0
    config.initial_weights = placeholder(str)
    config.model = {
        # 4 x 5 patches: the position embedding needs no more than a grid of 5.
        "encoder": {"embed_dim": 64, "depth": 2, "num_heads": 4, "position_grid": 5, "frozen": False},
        "aggregator": {
            "depth": 4,
            "num_heads": 4,
            "key_layers": (0, 1, 2, 3),
            "layer_scale": 1.0,
            "token_scale": 1.0,
        },
        "camera_head": {
            "depth": 1,
            "num_heads": 4,
            "layer_scale": 1.0,
            "initial_pose": initial_pose(HEIGHT, WIDTH),
        },
        "depth_head": {"features": 16, "out_channels": (16, 16, 16, 16)},
        "windows": {"size": 4, "stride": 2},
        "refinement": {"num_heads": 4},
        "dtype": "float32",
    }
    config.loss = {
        "name": "log_vggt",
        "camera_weight": 10.0,
        "depth_weight": 1.0,
        "translation_weight": 1.0,
        "rotation_weight": 1.0,
        "field_of_view_weight": 0.5,
        "gamma": 0.6,
        "alpha": 0.2,
    }
    # In the order written: unless told so, a ConfigDict sorts its keys.
    config.stages = ConfigDict(
        {
            "stage_1": stage(steps=2900, clip_length=4, batch_size=8, strides=(1, 6)),
            "stage_2": stage(steps=2200, clip_length=12, batch_size=4, strides=(1, 4)),
        },
        sort_keys=False,
    )
    config.optimizer = {
        "learning_rate": 1e-3,
        "final_learning_rate": 0.0,
        "schedule": "linear_tail",
        "warmup_fraction": 0.02,
        "restart_each_stage": False,
        "b1": 0.9,
        "b2": 0.99,
        "weight_decay": 0.02,
        "decay_all": False,
        "clip_norm": 1.0,
        "frozen": (),
    }
    rooms = {"height": HEIGHT, "width": WIDTH, "num_frames": 48, "style": "compass", "speed": (0.7, 1.3)}
    config.data = {
        # Half of the rooms face one wall: without them rotation stayed at the identity for 3,800 steps of one run.
        "sources": {
            "rooms": {
                "root": None,
                "split": "train",
                "options": {**rooms, "num_rooms": 1200, "facing_north": 0.5},
            },
        },
        "allow_missing": False,
        "min_valid_depth": 0.0,
        "max_broken": 0.0,
        "reverse": 0.5,
        "worker_count": 0,
        "num_threads": 1,
        "cache_dir": placeholder(str),
    }
    config.validation = {
        "sources": {"rooms": {"root": None, "split": "val", "options": {**rooms, "num_rooms": 16, "speed": 1.0}}},
        "every": 500,
        "num_clips": 16,
        "clip_length": 12,
        "stride": 2,
        "size": (HEIGHT, WIDTH),
        "best": "abs_rel",
    }
    config.log_every = 50
    config.save_every = 500
    config.keep_checkpoints = 2
    config.max_skipped_in_a_row = 20
    config.max_minutes = placeholder(float)
    config.accumulate = 1
    config.shard_parameters = False
    config.average = placeholder(float)
    return with_all_fields(config)


def stage(
    *, steps: int, clip_length: int, batch_size: int, strides: tuple[int, int], size: tuple[int, int] = (HEIGHT, WIDTH)
) -> dict:
    """A stage of the curriculum, of images of one `size`."""
    return {
        "steps": steps,
        "clip_length": clip_length,
        "batch_size": batch_size,
        "min_stride": strides[0],
        "max_stride": strides[1],
        "sizes": (size,),
    }


def unseen_rooms(weights: str) -> dict:
    """Options of rooms for a run that goes on from `weights`, which have not seen them: the seed follows from their
    parameters. None of these rooms face one wall: that is for the beginning, and no room is evaluated that does."""
    return {"seed": zlib.crc32(repr(read_digests(resolve(weights))).encode()), "facing_north": 0.0}
