"""LoG-VGGT learns from plain VGGT on videos of which nothing is known.

    python train.py --config=configs/distill.py:models/vggt-1b --workdir=runs/distilled \
        --source=images=data/videos,frames=:-300 --validation_source=images=data/videos,frames=-300:

After the colon stands the teacher, VGGT-1B as `logvggt convert` writes it or a hub repository; the student starts from
the same weights. `data/videos` holds folders of pictures (`ffmpeg -i walk.mp4 data/videos/walk/%06d.jpg`), or what
`logvggt data pack images data/videos` made of them. Before the first step the teacher labels every clip; its labels
are kept in `data.cache_dir`, which takes 8 bytes a pixel of the images trained on, 1.6 MB a frame of 392 x 518. Its
clips should be as long as memory allows: raise or lower teacher.clip_length.
"""

from ml_collections import ConfigDict

from configs import finetune
from logvggt_jax.training.config_fields import with_all_fields


def get_config(teacher: str = "facebook/VGGT-1B") -> ConfigDict:
    """The run; fields as in `configs/finetune.py`, whose sizes, schedule and data settings it has."""
    config = finetune.tuning(teacher)
    config.teacher = {"weights": teacher, "clip_length": 48, "stride": 2, "validation": True}
    config.loss.name = "distillation"
    config.stages = ConfigDict(
        {
            "stage_1": {**config.stages.stage_1.to_dict(), "steps": 20_000, "batch_size": 16},
            "stage_2": {**config.stages.stage_1.to_dict(), "steps": 4_000, "clip_length": 48, "batch_size": 4},
        },
        sort_keys=False,
    )
    # Strides are counted in the teacher's frames.
    config.stages.stage_2.max_stride = 1
    recording = {"root": "data/videos", "split": "all"}
    config.data.sources = ConfigDict({"images": {**recording, "frames": (None, -300)}})
    config.data.cache_dir = "runs/labels"
    config.data.worker_count = 8
    config.validation.sources = ConfigDict({"images": {**recording, "frames": (-300, None)}})
    config.validation.stride = 2
    config.validation.every = config.save_every = 1000
    config.log_every = 50
    return with_all_fields(config)
