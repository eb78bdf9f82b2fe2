"""How frames become predictions: windows of LoG-VGGT, plain VGGT on chunks, plain VGGT on everything."""

from logvggt_jax.streaming.chunks import ChunkPlan, ChunkSession
from logvggt_jax.streaming.merged import MergedSession, MergedSettings
from logvggt_jax.streaming.offline import OfflineSession, OfflineSettings
from logvggt_jax.streaming.predictor import METHODS, Method, Predictor, open_predictor
from logvggt_jax.streaming.results import Cameras, FrameResult, PredictionError
from logvggt_jax.streaming.windows import StreamSession, WindowSettings

__all__ = [
    "METHODS",
    "Cameras",
    "ChunkPlan",
    "ChunkSession",
    "FrameResult",
    "MergedSession",
    "MergedSettings",
    "Method",
    "OfflineSession",
    "OfflineSettings",
    "PredictionError",
    "Predictor",
    "StreamSession",
    "WindowSettings",
    "open_predictor",
]
