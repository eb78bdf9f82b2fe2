"""How frames become predictions: windows of LoG-VGGT, plain VGGT on chunks, plain VGGT on everything."""

from logvggt_jax.streaming.chunk_session import ChunkSession
from logvggt_jax.streaming.chunks import ChunkPlan
from logvggt_jax.streaming.windows import Cameras, FrameResult, StreamSession

__all__ = ["Cameras", "ChunkPlan", "ChunkSession", "FrameResult", "StreamSession"]
