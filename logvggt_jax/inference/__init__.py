"""Using the model: sources of frames, streams, reconstructions on disk, the viewer."""

from logvggt_jax.inference.chunk_session import ChunkSession
from logvggt_jax.inference.depth_files import read_depth, write_depth
from logvggt_jax.inference.point_cloud import PointFilter, write_point_cloud
from logvggt_jax.inference.reconstruct import Reconstruction, reconstruct
from logvggt_jax.inference.session import Cameras, FrameResult, StreamSession
from logvggt_jax.inference.sources import FolderSource, SourceFrame, VideoSource, open_source
from logvggt_jax.inference.trajectory_files import (
    read_cameras,
    read_trajectory,
    write_cameras,
    write_trajectory,
)
from logvggt_jax.model.chunks import ChunkPlan

__all__ = [
    "Cameras",
    "ChunkPlan",
    "ChunkSession",
    "FolderSource",
    "FrameResult",
    "PointFilter",
    "Reconstruction",
    "SourceFrame",
    "StreamSession",
    "VideoSource",
    "open_source",
    "read_cameras",
    "read_depth",
    "read_trajectory",
    "reconstruct",
    "write_cameras",
    "write_depth",
    "write_point_cloud",
    "write_trajectory",
]
