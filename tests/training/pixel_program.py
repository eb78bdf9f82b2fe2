"""`train.py` in processes of its own, with the model that compiles at once."""

# Statements to run before the program.
PIXEL_MODEL = """
import sys
sys.path[:0] = ["tests/training", "."]
import conftest
from logvggt_jax.training import loop
conftest.use_pixel_model(loop)
"""
# Flags of a run that does not end by itself; a test may add others, of which the last counts.
PIXEL_SETTINGS = (
    "--config=configs/tiny.py",
    "--config.stages.stage_1.steps=100000",
    "--config.stages.stage_1.batch_size=2",
    "--config.stages.stage_2.batch_size=2",
    # Each process renders its rooms, which otherwise takes as long as all else that it does.
    "--config.data.sources.rooms.options.num_rooms=2",
    "--config.data.sources.rooms.options.num_frames=24",
    "--config.validation.num_clips=2",
    "--config.validation.sources.rooms.options.num_rooms=2",
    "--config.validation.sources.rooms.options.num_frames=24",
    "--config.validation.every=100000",
    "--config.log_every=10",
    "--config.save_every=100000",
)
