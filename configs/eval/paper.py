"""Every table of the paper beside the paper's figures, on the benchmarks that are on disk.

    python eval.py --config=configs/eval/paper.py --checkpoint=runs/h20/model --data_root=data --output=runs/eval-paper

`data` holds one folder a data set, each in its official layout: seven_scenes, nrgbd, sintel, bonn, kitti, scannet, tum,
co3dv2. What is missing is named and counted. An interrupted evaluation goes on with the same command. Some of it:
--config.benchmarks="('seven_scenes-reconstruction-*',)". A small model needs its own size:
--config.protocol.longer_edge=70.
"""

from ml_collections import ConfigDict, config_dict

from logvggt_jax.data.option_fields import option_fields
from logvggt_jax.evaluation.settings import method_fields


def get_config() -> ConfigDict:
    """All benchmarks at the size of VGGT-1B; fields of `PaperRun`."""
    config = ConfigDict()
    config.title = "LoG-VGGT, the paper's benchmarks"
    # Patterns of benchmark names; any that matches none is an error that lists them.
    config.benchmarks = ("*",)
    config.baselines = True
    # All sequences; a number takes that many first ones of each benchmark, and the tables say so.
    config.max_sequences = config_dict.placeholder(int)
    # Clips of each benchmark that are drawn.
    config.figures = 1

    # Rows of the model: LoG-VGGT's windows, VGGT offline up to max_frames, VGGT on overlapping chunks chained together.
    config.methods = ("windows", "offline", "chunks")
    config.settings = method_fields({"offline": {"max_frames": 200}, "chunks": {"size": 60, "overlap": 30}})
    # Names of logvggt_jax/evaluation/methods/variants.py, evaluated beside the network.
    config.variants = ()

    # Sequences that are timed on this device for the tables of cost: --config.timings.lengths="(100, 200)" for fewer,
    # "()" for none.
    config.timings = ConfigDict({"lengths": (100, 200, 500, 1000), "rounds": 3})

    config.protocol = protocol = ConfigDict()
    protocol.longer_edge = 518
    # None compares all points, 10 to 50 million a sequence.
    protocol.max_points = 1_000_000
    protocol.icp_threshold = 0.1
    protocol.seed = 0
    # Of data sets' readers, by name.
    rooms = option_fields("rooms", {"num_rooms": 24, "style": "compass", "num_frames": 96})
    protocol.options = ConfigDict({"rooms": rooms})
    return config
