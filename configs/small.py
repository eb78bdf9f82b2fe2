"""A small LoG-VGGT for a GPU: 5 M parameters on images of 168 x 224 of procedural rooms.

    python train.py --config=configs/small.py --workdir=runs/small

Written for one large GPU, which draws the rooms itself, in pieces: a run stops after eight minutes, and the same
command goes on, to the same numbers, until all steps are done. On a CPU it runs at less than a tenth of the pace, in
float32: add --config.model.dtype=float32 and a larger --config.max_minutes. Where the memory of a GPU does not
suffice, lower the stages' batch_size. To go on from weights of these sizes, with clips of the last stage alone, on
rooms that they have not seen:

    python train.py --config=configs/small.py:runs/small/model --workdir=runs/small-more

Windows of four frames, the cache, GCCR and the losses are the paper's. A study of tiny models on rooms gave the rest,
which is `configs/tiny.py`'s where it is not written below: compass rooms, in which pose is learned at all, half of
them facing one wall, without which rotation stays at the identity for thousands of steps; single windows before
clips; LayerScale 1 and a thawed encoder, since nothing is pre-trained; a camera head that starts from no motion and
the mean field of view, with a weight of 10 in the loss. Muon learned rotation there in a fifth of AdamW's steps, most
of what clips of 12 frames taught came at rates of 1e-3 and below, and those of 32 frames still want 5e-4
(docs/results.md): a cosine gives them these. Camera paths are closed after 96 frames at the mean speed, so that most of
the longest clips return to where they began.
"""

from ml_collections import ConfigDict

from configs import tiny
from logvggt_jax.training.config_fields import with_all_fields

HEIGHT, WIDTH = SIZE = 168, 224


def get_config(initial_weights: str = "") -> ConfigDict:
    """The run from random numbers, or its last stage from `initial_weights`, which `from_pretrained` reads."""
    config = tiny.get_config()
    # 12 x 16 patches.
    config.model.encoder.update(embed_dim=128, position_grid=16)
    config.model.aggregator.update(depth=8, key_layers=(1, 3, 5, 7))
    config.model.camera_head.initial_pose = tiny.initial_pose(HEIGHT, WIDTH)
    config.model.depth_head = {"features": 32, "out_channels": (32, 64, 64, 64)}
    config.model.dtype = "bfloat16"
    config.stages = ConfigDict(
        {
            "stage_1": tiny.stage(steps=6000, clip_length=4, batch_size=32, strides=(1, 6), size=SIZE),
            "stage_2": tiny.stage(steps=4000, clip_length=12, batch_size=16, strides=(1, 6), size=SIZE),
            "stage_3": tiny.stage(steps=4000, clip_length=32, batch_size=8, strides=(1, 6), size=SIZE),
        },
        sort_keys=False,
    )
    rooms = {"height": HEIGHT, "width": WIDTH, "num_frames": 192}
    # As many rooms as are kept laid out in memory.
    config.data.sources.rooms.options.update(rooms, num_rooms=2000, renderer="device")
    config.validation.sources.rooms.options.update(rooms)
    config.validation.size = SIZE
    config.validation.every = 1000
    config.save_every = 1000
    config.max_minutes = 8.0
    config.optimizer.update(algorithm="muon", learning_rate=3e-3, schedule="cosine")
    if initial_weights:
        config.initial_weights = initial_weights
        for name in ("stage_1", "stage_2"):
            del config.stages[name]
        config.optimizer.learning_rate = 1e-3
        config.data.sources.rooms.options.update(tiny.unseen_rooms(initial_weights))
    return with_all_fields(config)
