"""Depth, poses and points on 7-Scenes, real RGB-D frames.

    python eval.py --config=configs/eval/seven_scenes.py --checkpoint=runs/tiny/model --data_root=7scenes \
        --output=runs/eval-7scenes

The folder holds `<scene>/seq-NN/frame-NNNNNN.{color.png|jpg,depth.png,pose.txt}`. This is a short setting for
small models; it is not the paper's protocol.
"""

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder

from logvggt_jax.evaluation.settings import method_fields


def get_config() -> ConfigDict:
    """Clips of 12 and 32 frames of every sequence; fields of `ClipRun`."""
    config = ConfigDict()
    config.title = "7-Scenes"
    config.dataset = "seven_scenes"
    # "test" needs the official TestSplit.txt in every scene's folder.
    config.split = "all"
    config.options = ConfigDict()  # this set's reader has none
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
    # (H, W), to which frames are scaled and cropped; by default 3:4 and as large as the model was trained at.
    evaluation.image_size = placeholder(tuple)
    evaluation.clip_lengths = (12, 32)
    # About 8 degrees of rotation from frame to frame, as in the procedural rooms at stride 2.
    evaluation.stride = 5
    evaluation.clips_per_sequence = 8
    # Only that many first sequences; None takes all.
    evaluation.max_sequences = placeholder(int)
    # From two sets of sequences on, tables show the standard deviation of the sets' means.
    evaluation.sets = 1
    evaluation.max_points = 20_000
    evaluation.icp_threshold = 0.1
    evaluation.seed = 0
    evaluation.figures = 2
    return config
