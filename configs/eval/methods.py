"""Every method on the same weights, rooms and clock: ATE, depth, frames/s and bytes kept as sequences grow.

    python eval.py --config=configs/eval/methods.py --checkpoint=rooms --output=runs/eval-methods

The report has a table and a panel of figures/by_length.png for each of the four. The network is trained for one method,
LoG-VGGT's windows as configs/demo.py and configs/tiny.py train it, or whatever the checkpoint was trained for: the
others show what they make of weights that are not theirs. Some of them:

    python eval.py --config=configs/eval/methods.py --config.methods="('windows', 'causal', 'rolling')" \
        --checkpoint=rooms --output=runs/eval-three-methods
"""

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder

from logvggt_jax.data.option_fields import option_fields
from logvggt_jax.evaluation.settings import method_fields

LENGTHS = (12, 25, 50, 100)


def get_config() -> ConfigDict:
    """One clip of each length of eight test rooms; fields of `ClipRun`."""
    config = ConfigDict()
    config.title = "Methods on one network, procedural rooms"
    config.dataset = "rooms"
    config.split = "test"
    # Rooms of the kind that configs/tiny.py trains on, once round at stride 2.
    config.options = option_fields("rooms", {"num_rooms": 8, "style": "compass", "num_frames": 200})
    config.baselines = True
    # Rows of the model, names of logvggt_jax.streaming.METHODS; the first one is drawn.
    config.methods = (
        "windows",
        "causal",
        "anchored-window",
        "rolling",
        "pruned",
        "merged",
        "offline",
        "chunks",
    )
    # Tokens are those of the tiny model: 25 a frame of 56 x 70 pixels, four layers. All bounded methods are full well
    # before the longest clip ends: 12 frames of every layer, the first frame, the newest and six frames' worth of
    # others, 12 frames of a chunk.
    config.settings = method_fields(
        {
            "rolling": {"budget": 12 * 25 * 4},
            "pruned": {"cap": 8 * 25},
            "offline": {"max_frames": 200},
            "chunks": {"size": 12, "overlap": 6},
        }
    )
    # Names of logvggt_jax/evaluation/methods/variants.py, evaluated beside the methods.
    config.variants = ()
    # Sequences of random pictures, timed on this device.
    config.timings = ConfigDict({"lengths": LENGTHS, "rounds": 3})

    config.evaluation = evaluation = ConfigDict()
    # (H, W) of the images; by default 3:4 and as large as those that the model was trained at.
    evaluation.image_size = placeholder(tuple)
    evaluation.clip_lengths = LENGTHS
    evaluation.stride = 2
    evaluation.clips_per_sequence = 1
    # Only that many first sequences; None takes all.
    evaluation.max_sequences = placeholder(int)
    # From two sets of sequences on, tables show the standard deviation of the sets' means.
    evaluation.sets = 1
    evaluation.max_points = 10_000
    evaluation.icp_threshold = 0.1
    evaluation.seed = 0
    evaluation.figures = 1
    return config
