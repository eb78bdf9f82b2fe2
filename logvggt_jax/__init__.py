"""LoG-VGGT in JAX: camera poses, depth and point clouds from videos of any length at constant memory."""

from importlib.metadata import version

from etils import epy

# Names are imported when they are first used: JAX takes seconds to load, `logvggt --help` should not.
with epy.lazy_api_imports(globals()):
    from logvggt_jax import (
        config,
        data,
        evaluation,
        geometry,
        metrics,
        model,
        reconstruction,
        streaming,
        training,
        types,
        weights,
    )
    from logvggt_jax.config import (
        AggregatorConfig,
        CameraHeadConfig,
        DPTConfig,
        EncoderConfig,
        ModelConfig,
        RefinementConfig,
        WindowConfig,
    )
    from logvggt_jax.data.feeding.transforms import preprocess
    from logvggt_jax.frames import Frames
    from logvggt_jax.model.logvggt import LogVGGT
    from logvggt_jax.model.windows import WindowState
    from logvggt_jax.streaming import StreamSession
    from logvggt_jax.types import Predictions, WindowOutput
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
    "StreamSession",
    "WindowConfig",
    "WindowOutput",
    "WindowState",
    "config",
    "data",
    "evaluation",
    "from_pretrained",
    "geometry",
    "load_model",
    "metrics",
    "model",
    "preprocess",
    "reconstruction",
    "streaming",
    "training",
    "types",
    "weights",
]
