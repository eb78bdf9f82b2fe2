"""Two minutes of training for `make demo`: the tiny model's depth, from nothing.

python train.py --config=configs/demo.py --workdir=runs/demo/training
"""

from ml_collections import ConfigDict

from configs import tiny
from logvggt_jax.training.config_fields import with_all_fields


def get_config() -> ConfigDict:
    """`configs/tiny.py` with fewer rooms, and few steps of single windows alone."""
    config = tiny.get_config()
    config.stages.stage_1.steps = 300
    del config.stages.stage_2
    config.optimizer.warmup_fraction = 0.1
    config.data.sources.rooms.options.num_rooms = 200
    config.validation.every = 100
    config.save_every = 300
    config.log_every = 20
    config.max_minutes = 4.0
    return with_all_fields(config)
