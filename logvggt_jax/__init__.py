"""LoG-VGGT in JAX: camera poses, depth and point clouds from videos of any length at constant memory."""

from importlib.metadata import version

from logvggt_jax.config import (
    AggregatorConfig,
    CameraHeadConfig,
    DPTConfig,
    EncoderConfig,
    ModelConfig,
    RefinementConfig,
    WindowConfig,
)
from logvggt_jax.data.transforms import preprocess
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.windows import WindowState
from logvggt_jax.types import Frames, Predictions, WindowOutput
from logvggt_jax.weights.checkpoints import from_pretrained, load_model

__version__ = version("logvggt-jax")

__all__ = [
    "AggregatorConfig",
    "CameraHeadConfig",
    "DPTConfig",
    "EncoderConfig",
    "Frames",
    "LogVGGT",
    "ModelConfig",
    "Predictions",
    "RefinementConfig",
    "WindowConfig",
    "WindowOutput",
    "WindowState",
    "from_pretrained",
    "load_model",
    "preprocess",
]
