"""The paper's training: VGGT-1B fine-tuned on eleven data sets, 16 accelerators of 96 GB.

    python train.py --config=configs/h20.py --workdir=runs/h20 --config.initial_weights=checkpoints/vggt-1b

`initial_weights` takes what `logvggt convert` wrote, a VGGT checkpoint, or a hub repository. Set the data sets'
folders with --config.data.sources.scannet.root=/data/scannet and so on; --config=configs/h20.py:DATA_ROOT puts all
of them under one folder. --config.data.allow_missing=True trains on those that are there. A stage can be trained alone,
the second from what the first has left in another work folder, or from any other weights:

    python train.py --config=configs/h20.py:DATA_ROOT,stage_2 --workdir=runs/h20-long \
        --config.initial_weights=runs/h20/model

The paper gives clip
lengths, epochs, windows and data sets. Optimiser, mixture, strides, batch sizes and the length of an epoch are choices
of this project.
"""

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder

from logvggt_jax.data.feeding.holdouts import PUBLISHED
from logvggt_jax.errors import InputError
from logvggt_jax.training.config_fields import with_all_fields

STEPS_PER_EPOCH = 800
NUM_DEVICES = 16
# (height, width), the longer edge 518: aspect ratios of the data sets, as StreamVGGT trains them.
LANDSCAPE = ((392, 518), (336, 518), (294, 518), (266, 518), (210, 518), (154, 518))
PORTRAIT = ((518, 392), (518, 336), (518, 294), (518, 266))
# Clips of each data set per 30,900: StreamVGGT's mixture, ARKitScenes' two forms as one, Replica as the smallest. The
# largest distance between frames is CUT3R's, Replica's as ScanNet's; BlendedMVS has no order in time and is walked.
MIXTURE = {
    "co3dv2": (4500, 25),
    "wildrgbd": (4500, 25),
    "arkitscenes": (6750, 8),
    "scannet": (4500, 30),
    "hypersim": (1200, 4),
    "blendedmvs": (2250, None),
    "virtual_kitti": (2250, 5),
    "spring": (1800, 16),
    "mvs_synth": (450, 4),
    "pointodyssey": (2250, 4),
    "replica": (450, 30),
}


def get_config(data_root: str = "data") -> ConfigDict:
    """The run; the model's sizes are the defaults of `ModelConfig`, VGGT-1B. After a comma, the name of its one stage.

    Raises InputError for a stage that it does not have.
    """
    data_root, _, stage = data_root.partition(",")
    data_root = data_root or "data"
    config = ConfigDict()
    config.seed = 0
    config.initial_weights = "facebook/VGGT-1B"
    config.model = {
        "windows": {"size": 4, "stride": 2, "cross_window": True, "cache": "output"},
        "refinement": {"enabled": True, "period": placeholder(int), "context": placeholder(int)},
        "dtype": "bfloat16",
    }
    config.loss = {
        "name": "log_vggt",
        "camera_weight": 1.0,
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
            "stage_1": _stage(epochs=100, clip_length=12, clips_a_device=4),
            "stage_2": _stage(epochs=10, clip_length=64, clips_a_device=1),
        },
        sort_keys=False,
    )
    if stage:
        if stage not in config.stages:
            raise InputError(f"configs/h20.py has stages {', '.join(config.stages)}, got {stage!r} after the comma")
        config.stages = ConfigDict({stage: config.stages[stage]})
    config.optimizer = {
        "learning_rate": 5e-5,
        "final_learning_rate": 1e-8,
        "schedule": "cosine",
        "warmup_fraction": 0.05,
        # The second stage is a fine-tuning of its own: at the end of one long cosine it would learn nothing.
        "restart_each_stage": True,
        "b1": 0.9,
        "b2": 0.999,
        "weight_decay": 0.05,
        "decay_all": False,
        "clip_norm": 1.0,
        "frozen": (),
    }
    config.data = {
        "sources": {
            name: {
                "root": f"{data_root}/{name}",
                "split": "train",
                "weight": float(weight),
                **({"stride": (1, max_stride)} if max_stride else {}),
            }
            for name, (weight, max_stride) in MIXTURE.items()
        },
        # Never trained on: the run refuses to start if a source contains one of these sequences.
        "hold_out": {
            name: {"names": rule.names} if rule.names else {"split": rule.split} for name, rule in PUBLISHED.items()
        },
        "allow_missing": False,
        # VGGT's colour jitter, one draw a clip in seven of ten, and its blur, which it leaves off.
        "augmentation": {
            "shared": 0.7,
            "jitter": 0.9,
            "brightness": 0.5,
            "contrast": 0.5,
            "saturation": 0.5,
            "hue": 0.1,
            "grey": 0.05,
            "blur": 0.05,
            "blur_sigma": (0.1, 1.0),
        },
        "min_valid_depth": 0.01,
        "max_broken": 0.01,
        "reverse": 0.5,
        "worker_count": 16,
        "num_threads": 2,
        "cache_dir": placeholder(str),
    }
    config.validation = {
        "sources": {name: {"root": f"{data_root}/{name}", "split": "val"} for name in ("scannet", "arkitscenes")},
        "every": 5 * STEPS_PER_EPOCH,
        # Of each source.
        "num_clips": NUM_DEVICES,
        "clip_length": 12,
        "stride": 10,
        "size": LANDSCAPE[0],
        "best": "abs_rel",
    }
    config.log_every = 50
    config.save_every = STEPS_PER_EPOCH
    config.keep_checkpoints = 3
    config.max_skipped_in_a_row = 20
    config.max_minutes = placeholder(float)
    config.accumulate = 1
    config.shard_parameters = False
    config.average = placeholder(float)
    return with_all_fields(config)


def _stage(*, epochs: int, clip_length: int, clips_a_device: int) -> dict:
    return {
        "steps": epochs * STEPS_PER_EPOCH,
        "clip_length": clip_length,
        "batch_size": clips_a_device * NUM_DEVICES,
        "min_stride": 1,
        "max_stride": 8,
        "sizes": LANDSCAPE + PORTRAIT,
    }
