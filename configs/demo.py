"""Two minutes of training from nothing, for `make demo`.

python train.py --config=configs/demo.py --workdir=runs/demo/training
"""

from ml_collections import ConfigDict

from configs import tiny


def get_config() -> ConfigDict:
    """`configs/tiny.py` on single windows of few rooms, with a validation often enough to draw a curve."""
    config = tiny.get_config()
    # Two minutes end it before, on two cores.
    config.stages.stage_1.steps = 2000
    del config.stages["stage_2"]
    config.optimizer.warmup_fraction = 0.05
    config.data.sources.rooms.options.num_rooms = 150
    config.data.sources.rooms.options.num_frames = 24
    config.validation.every = 100
    config.log_every = 20
    config.validation.clip_length = 4
    config.save_every = 1000
    config.max_minutes = 2.0
    return config
