"""A tiny LoG-VGGT that never sees the truth: it learns procedural rooms from the model that ships, on two CPU cores.

    python scripts/rooms_teacher.py runs/teacher
    python train.py --config=configs/distill_rooms.py:runs/teacher --workdir=runs/student

After the colon stands the teacher. docs/own-sequences.md says how long it took. Sizes, rooms, schedule and steps are
those of `configs/tiny.py`: what that run learns from the truth, this one learns from its teacher's predictions of 24
frames at a time. Strides differ a little, since the teacher sees every second frame.
"""

from ml_collections import ConfigDict

from configs import tiny
from logvggt_jax.training.config_fields import with_all_fields


def get_config(teacher: str = "./runs/teacher") -> ConfigDict:
    """The run; fields as in `configs/tiny.py`."""
    config = tiny.get_config()
    config.teacher = {"weights": teacher, "clip_length": 24, "stride": 2, "validation": True}
    config.loss.name = "distillation"
    # Strides are counted in the teacher's frames, every second one.
    config.stages.stage_1.max_stride = 3
    config.stages.stage_2.max_stride = 2
    config.data.cache_dir = "runs/labels"
    return with_all_fields(config)
