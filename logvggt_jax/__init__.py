"""LoG-VGGT in JAX: camera poses, depth and point clouds from videos of any length at constant memory."""

from importlib.metadata import version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
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
    from logvggt_jax.model.logvggt import LogVGGT
    from logvggt_jax.model.windows import WindowState
    from logvggt_jax.streaming import StreamSession
    from logvggt_jax.types import Frames, Predictions, WindowOutput
    from logvggt_jax.weights.checkpoints import from_pretrained, load_model
else:
    # Names are imported when they are first used: JAX takes seconds to load, `logvggt --help` should not.
    _NAMES = {
        "config": (
            "AggregatorConfig",
            "CameraHeadConfig",
            "DPTConfig",
            "EncoderConfig",
            "ModelConfig",
            "RefinementConfig",
            "WindowConfig",
        ),
        "data.transforms": ("preprocess",),
        "model.logvggt": ("LogVGGT",),
        "model.windows": ("WindowState",),
        "streaming": ("StreamSession",),
        "types": ("Frames", "Predictions", "WindowOutput"),
        "weights.checkpoints": ("from_pretrained", "load_model"),
    }
    _MODULES = {name: module for module, names in _NAMES.items() for name in names}
    _PARTS = (
        "config",
        "data",
        "evaluation",
        "geometry",
        "metrics",
        "model",
        "reconstruction",
        "streaming",
        "training",
        "types",
        "weights",
    )

    def __getattr__(name):
        from importlib import import_module

        if name in _MODULES:
            return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
        if name in _PARTS:
            return import_module(f"{__name__}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return sorted({*globals(), *__all__, *_PARTS})


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
    "from_pretrained",
    "load_model",
    "preprocess",
]
