"""Data sets with one interface, procedural rooms, resizing, and training batches through Grain."""

from logvggt_jax.data.dataset import Dataset, check_frames
from logvggt_jax.data.pipeline import BatchIterator, training_batches
from logvggt_jax.data.registry import DATASETS, open_dataset
from logvggt_jax.data.room_pool import RoomPool, render_pool
from logvggt_jax.data.rooms import Rooms
from logvggt_jax.data.seven_scenes import SevenScenes
from logvggt_jax.data.transforms import ResizeTransform, fit, preprocess
from logvggt_jax.types import Frames

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
