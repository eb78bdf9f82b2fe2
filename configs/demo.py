"""The tiny model for `make demo`.

python train.py --config=configs/demo.py --workdir=runs/demo/training
"""

from ml_collections import ConfigDict

from configs import tiny


def get_config() -> ConfigDict:
    """`configs/tiny.py` with fewer rooms and steps."""
    config = tiny.get_config()
    config.stages.stage_1.steps = 550
    config.stages.stage_2.steps = 80
    config.optimizer.warmup_fraction = 0.1
    config.data.sources.rooms.options.num_rooms = 500
    config.validation.every = 300
    config.save_every = 300
    config.max_minutes = 6.0
    return config
