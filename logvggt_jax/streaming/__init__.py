"""How frames become predictions: LoG-VGGT's windows, and the other methods for the same network."""

from logvggt_jax.streaming.anchored_window import AnchoredWindowSettings
from logvggt_jax.streaming.causal import CausalSettings
from logvggt_jax.streaming.chunks import ChunkPlan, ChunkSession
from logvggt_jax.streaming.loops import LoopSettings
from logvggt_jax.streaming.merged import MergedSession, MergedSettings
from logvggt_jax.streaming.offline import OfflineSession, OfflineSettings
from logvggt_jax.streaming.predictor import METHODS, Method, Predictor, open_predictor
from logvggt_jax.streaming.pruned import PrunedSettings
from logvggt_jax.streaming.results import Cameras, FrameResult, PredictionError, Progress, Signals
from logvggt_jax.streaming.rolling import RollingSettings
from logvggt_jax.streaming.state_file import load_stream, save_stream
from logvggt_jax.streaming.suitability import expectation
from logvggt_jax.streaming.windows import StreamSession, WindowSettings

__all__ = [
    "METHODS",
    "AnchoredWindowSettings",
    "Cameras",
    "CausalSettings",
    "ChunkPlan",
    "ChunkSession",
    "FrameResult",
    "LoopSettings",
    "MergedSession",
    "MergedSettings",
    "Method",
    "OfflineSession",
    "OfflineSettings",
    "PredictionError",
    "Predictor",
    "Progress",
    "PrunedSettings",
    "RollingSettings",
    "Signals",
    "StreamSession",
    "WindowSettings",
    "expectation",
    "load_stream",
    "open_predictor",
    "save_stream",
]
