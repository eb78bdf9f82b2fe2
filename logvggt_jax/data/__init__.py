"""Data sets with one interface, procedural rooms, resizing, and training batches through Grain."""

from etils import epy

# Names are imported when they are first used: Grain takes seconds to load, opening a data set should not.
with epy.lazy_api_imports(globals()):
    from logvggt_jax.data.dataset import Dataset, check_frames
    from logvggt_jax.data.feeding.batches import BatchIterator, training_batches
    from logvggt_jax.data.feeding.transforms import ResizeTransform, fit, preprocess
    from logvggt_jax.data.readers.seven_scenes import SevenScenes
    from logvggt_jax.data.registry import DATASETS, open_dataset
    from logvggt_jax.data.rooms.pool import RoomPool, render_pool
    from logvggt_jax.data.rooms.rooms import Rooms
    from logvggt_jax.frames import Frames

__all__ = [
    "DATASETS",
    "BatchIterator",
    "Dataset",
    "Frames",
    "ResizeTransform",
    "RoomPool",
    "Rooms",
    "SevenScenes",
    "check_frames",
    "fit",
    "open_dataset",
    "preprocess",
    "render_pool",
    "training_batches",
]
