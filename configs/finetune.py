"""Fine-tuning on sequences of one's own, from VGGT-1B or from a LoG-VGGT model.

    python train.py --config=configs/finetune.py:models/vggt-1b --workdir=runs/mine \
        --source=tum_recording=data/mine,frames=:-200 --validation_source=tum_recording=data/mine,frames=-200:

After the colon stands what to start from: a model folder, whose sizes and image size the run takes over, a VGGT
checkpoint, or a hub repository of VGGT-1B (`facebook/VGGT-1B` where nothing is said). `docs/own-sequences.md` says in
which forms sequences can lie on the disk. Batches of 4 clips of 12 frames fit one accelerator of 96 GB at VGGT-1B's
size; on smaller ones lower stages.stage_1.clip_length, or freeze more: --config.optimizer.frozen="('aggregator/*',)".
"""

import dataclasses

from ml_collections import ConfigDict

from configs import h20
from logvggt_jax.config import PATCH, ModelConfig
from logvggt_jax.errors import MissingInput
from logvggt_jax.training.config_fields import with_all_fields
from logvggt_jax.weights.address import hub_address, resolve
from logvggt_jax.weights.checkpoints import read_config, read_provenance

SMALL = 512  # width below which a model was trained from nothing, at a rate that large ones do not bear
LONGER_EDGE = 518
LAST = 200  # frames of a recording that are kept to validate on


def get_config(model: str = "facebook/VGGT-1B") -> ConfigDict:
    """The run; fields as in `configs/h20.py`, whose data settings and objective it has."""
    try:
        return tuning(model)
    except MissingInput as error:
        goes_on = "a run that has begun goes on without it: give its --workdir after the colon instead"
        raise MissingInput(f"{error}; {goes_on}") from error


def tuning(model: str) -> ConfigDict:
    """The same, which other configurations build on."""
    sizes, longer_edge = ModelConfig(dtype="bfloat16"), LONGER_EDGE
    if hub_address(model) is None:  # what the hub has is not fetched to be looked at
        path = resolve(model)
        sizes, longer_edge = read_config(path), read_provenance(path).longer_edge or LONGER_EDGE
        if sizes.encoder.embed_dim >= SMALL:  # a converted VGGT says float32, in which it is stored
            sizes = dataclasses.replace(sizes, dtype="bfloat16")
    config = h20.get_config()
    config.initial_weights = model
    config.model = sizes.to_dict()
    images = [(_edge(longer_edge * part), longer_edge) for part in (3 / 4, 9 / 16)]
    config.stages = {
        "stage_1": {
            "steps": 600,
            "clip_length": 12,
            "batch_size": 4,
            "min_stride": 1,
            "max_stride": 8,
            # A stage compiles those that its pictures have; of the smallest edges some are one.
            "sizes": tuple(dict.fromkeys((*images, *((width, height) for height, width in images)))),
        }
    }
    config.optimizer.learning_rate = 5e-4 if sizes.encoder.embed_dim < SMALL else 2e-5
    recording = {"root": "data/own", "split": "all"}
    config.data.sources = ConfigDict({"tum_recording": {**recording, "frames": (None, -LAST)}})
    config.data.hold_out = ConfigDict()
    config.data.max_broken = 0.05
    config.data.worker_count = 2
    config.validation = {
        "sources": {"tum_recording": {**recording, "frames": (-LAST, None)}},
        "every": 200,
        "num_clips": 8,
        "clip_length": 12,
        "stride": 5,
        "size": images[0],
        "best": "abs_rel",
    }
    config.log_every = 20
    config.save_every = 200
    return with_all_fields(config)


def _edge(pixels: float) -> int:
    return max(PATCH, PATCH * round(pixels / PATCH))
