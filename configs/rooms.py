"""A model like the one that ships as `rooms`, half as deep: 2 M parameters, images of 56 x 70 of procedural rooms.

    python train.py --config=configs/rooms.py --workdir=runs/rooms

The same command goes on with the run until all steps are done; on two CPU cores that takes about seventy minutes. What
ships went on from such a run and was made twice as deep on the way (scripts/deepen_model.py), as `logvggt info rooms`
says. To go on from there, on clips of 12 and of 32 frames in turn (scripts/train_small.sh does it):

    python train.py --config=configs/rooms.py:rooms --workdir=runs/rooms-more

`configs/small.py` is the larger model for a GPU, `configs/tiny.py` the one for half an hour.
"""

from ml_collections import ConfigDict

from configs import tiny
from logvggt_jax.training.config_fields import with_all_fields
from logvggt_jax.weights.address import resolve
from logvggt_jax.weights.checkpoints import read_config

TURNS = 30  # of fifty steps each


def get_config(initial_weights: str = "") -> ConfigDict:
    """`configs/tiny.py` with wider blocks, Muon, a moving average, and a stage of clips that return to their start.

    With Muon rotation is learned after six hundred steps of single windows; with AdamW it took three thousand.

    From random numbers, or from `initial_weights`, a model folder, whose sizes it then has: without single windows, in
    turns on clips of 12 and of 32 frames, and on rooms that these weights have not seen: 1,200 rooms were learned by
    heart within hours, and new ones are quickly rendered.
    """
    config = tiny.get_config()
    config.model.encoder.embed_dim = 96
    config.optimizer.update(algorithm="muon", learning_rate=3e-3)
    config.stages.stage_1.steps = 1500
    config.stages.stage_2.update(steps=3300, max_stride=6)
    # Camera paths close after 96 frames at the mean speed.
    config.data.sources.rooms.options.num_frames = 96
    config.stages.stage_3 = {**config.stages.stage_2, "steps": 150, "clip_length": 32, "batch_size": 2, "max_stride": 3}
    config.average = 0.999
    config.validation.every = 1000
    if initial_weights:
        config.initial_weights = initial_weights
        config.model = read_config(resolve(initial_weights)).to_dict()
        # In turn: a model that was trained on 12 frames alone forgot 32.
        lengths = (
            tiny.stage(steps=50, clip_length=12, batch_size=8, strides=(1, 4)),
            tiny.stage(steps=50, clip_length=32, batch_size=4, strides=(1, 3)),
        )
        config.stages = ConfigDict({f"stage_{n + 1}": lengths[n % 2] for n in range(TURNS)}, sort_keys=False)
        config.optimizer.update(learning_rate=5e-4, schedule="cosine")
        config.loss.translation_weight = 2.0
        config.data.sources.rooms.options.update(num_rooms=2400, **tiny.unseen_rooms(initial_weights))
        config.data.cache_dir = "runs/rooms-cache"  # 6.3 GB, more than is kept in memory
    return with_all_fields(config)
