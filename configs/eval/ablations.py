"""Ablations of one checkpoint at 10, 100 and 300 frames of three sets of rooms, beside VGGT offline and on chunks.

    python eval.py --config=configs/eval/ablations.py --checkpoint=runs/tiny/model --output=runs/ablations

Every variant is run twice, with the camera head's trunk over all frames and limited to the window's size: over all
frames it is a global path of its own, which hides what the parts do. Another data set:

    python eval.py --config=configs/eval/ablations.py:seven_scenes --data_root=7scenes --checkpoint=runs/tiny/model \
        --output=runs/ablations-7scenes
"""

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder

from logvggt_jax.data.option_fields import option_fields
from logvggt_jax.evaluation.settings import method_fields


def get_config(dataset: str = "rooms") -> ConfigDict:
    """Clips of procedural rooms, or of another `dataset`, the full model and its variants; fields of `ClipRun`."""
    is_rooms = dataset == "rooms"
    config = ConfigDict()
    config.title = "Ablations"
    config.dataset = dataset
    config.split = "test" if is_rooms else "all"
    # Rooms of the kind that configs/tiny.py trains on, walked round seven times, each time a little aside.
    walked = {"num_rooms": 24, "style": "compass", "num_frames": 600, "laps": 7}
    config.options = option_fields(dataset, walked if is_rooms else {})
    config.baselines = True
    # Rows of the model: LoG-VGGT's windows, VGGT offline up to max_frames, and VGGT on overlapping chunks, as long as
    # the model was trained at.
    config.methods = ("windows", "offline", "chunks")
    config.settings = method_fields({"offline": {"max_frames": 300}, "chunks": {"size": 12, "overlap": 6}})
    # Names of logvggt_jax/evaluation/methods/variants.py.
    config.variants = (
        "full",
        "no_gccr",
        "gccr_every_50",
        "gccr_every_100",
        "gccr_online",
        "gccr_loops",
        "windows_chained",
        "no_cwa",
        "no_cwa_no_gccr",
        "cache_output",
        "cache_input",
        "windows_2_1",
        "windows_4_1",
        "windows_4_2",
        "windows_4_3",
        "windows_8_2",
        "windows_8_4",
        "windows_16_8",
    )
    # Sequences that are timed on this device, by their numbers of frames.
    config.timings = ConfigDict({"lengths": (), "rounds": 3})

    config.evaluation = evaluation = ConfigDict()
    # (H, W) of the images; by default 3:4 and as large as those that the model was trained at.
    evaluation.image_size = placeholder(tuple)
    evaluation.clip_lengths = (10, 100, 300)
    evaluation.stride = 2 if is_rooms else 1
    evaluation.clips_per_sequence = 1
    # Only that many first sequences; None takes all.
    evaluation.max_sequences = placeholder(int)
    # Tables show the standard deviation of the sets' means beside the mean of all rooms.
    evaluation.sets = 3
    evaluation.max_points = 10_000
    evaluation.icp_threshold = 0.1
    evaluation.seed = 0
    evaluation.figures = 2
    return config
