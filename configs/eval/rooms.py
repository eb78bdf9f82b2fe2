"""Depth, poses and points on procedural rooms that training never saw.

python eval.py --config=configs/eval/rooms.py --checkpoint=runs/tiny/model --output=runs/eval-rooms
"""

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder

from logvggt_jax.data.option_fields import option_fields
from logvggt_jax.evaluation.settings import method_fields


def get_config() -> ConfigDict:
    """Clips of 12 and 32 frames of each test room; fields of `ClipRun`."""
    config = ConfigDict()
    config.title = "Procedural rooms, test split"
    config.dataset = "rooms"
    config.split = "test"
    # Rooms of the kind that configs/tiny.py trains on.
    config.options = option_fields("rooms", {"num_rooms": 24, "style": "compass", "num_frames": 96})
    config.baselines = True
    # Rows of the model: LoG-VGGT's windows, VGGT offline up to max_frames, and VGGT on overlapping chunks, as long as
    # the model was trained at.
    config.methods = ("windows", "offline", "chunks")
    config.settings = method_fields({"offline": {"max_frames": 200}, "chunks": {"size": 12, "overlap": 6}})
    # Names of logvggt_jax/evaluation/methods/variants.py, evaluated beside the methods.
    config.variants = ()
    # Sequences that are timed on this device, by their numbers of frames.
    config.timings = ConfigDict({"lengths": (), "rounds": 3})

    config.evaluation = evaluation = ConfigDict()
    # (H, W) of the images; by default 3:4 and as large as those that the model was trained at.
    evaluation.image_size = placeholder(tuple)
    evaluation.clip_lengths = (12, 32)
    evaluation.stride = 2
    evaluation.clips_per_sequence = 1
    # Only that many first sequences; None takes all.
    evaluation.max_sequences = placeholder(int)
    # From two sets of sequences on, tables show the standard deviation of the sets' means.
    evaluation.sets = 1
    evaluation.max_points = 10_000
    evaluation.icp_threshold = 0.1
    evaluation.seed = 0
    evaluation.figures = 2
    return config
