"""Sizes and choices of the model as frozen dataclasses: validated on construction, hashable, static under jit.

Defaults are VGGT-1B and the LoG-VGGT paper.
"""

from __future__ import annotations

import contextlib
import dataclasses
import types
import typing
from typing import Any

import jax.numpy as jnp

from logvggt_jax.errors import InputError

ATTENTION_IMPLEMENTATIONS = ("auto", "xla", "cudnn", "tpu_flash")


def _positive(config: Any, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"{type(config).__name__}.{name} must be a positive integer, got {value!r}")


def _divides(config: Any, width: int, num_heads: int, multiple: int, why: str) -> None:
    if width % num_heads or (width // num_heads) % multiple:
        raise ValueError(
            f"{type(config).__name__}.num_heads={num_heads} must split the width {width} into heads whose size "
            f"is a multiple of {multiple} ({why})"
        )


@dataclasses.dataclass(frozen=True)
class EncoderConfig:
    """DINOv2 with registers: one frame's image to patch tokens.

    `position_grid` is the side of the square grid on which the position embedding is stored. A `frozen`
    encoder receives no gradient (the paper); a model trained from nothing has to thaw it.
    """

    embed_dim: int = 1024
    depth: int = 24
    num_heads: int = 16
    mlp_ratio: int = 4
    num_registers: int = 4
    position_grid: int = 37
    patch_size: int = 14
    frozen: bool = True

    def __post_init__(self) -> None:
        _positive(self, "embed_dim", "depth", "num_heads", "mlp_ratio", "num_registers", "position_grid")
        if self.patch_size != 14:
            raise InputError(
                f"EncoderConfig.patch_size must be 14, as VGGT's and all resizing here, got {self.patch_size!r}"
            )
        _divides(self, self.embed_dim, self.num_heads, 1, "one slice of channels a head")


@dataclasses.dataclass(frozen=True)
class AggregatorConfig:
    """Alternating frame and global attention; its width is the encoder's.

    The `key_layers` (0-based) are both the layers of cross-window attention and the depth head's taps.
    `layer_scale` is the initial value of the residual branches' gains, `token_scale` the standard deviation of the
    initial camera and register tokens. VGGT's 1e-6 suits pre-trained weights; from nothing, a LayerNorm turns it
    into gradients thousands of times too large.
    """

    depth: int = 24
    num_heads: int = 16
    mlp_ratio: int = 4
    num_registers: int = 4
    rope_base: float = 100.0
    key_layers: tuple[int, ...] = (4, 11, 17, 23)
    layer_scale: float = 0.01
    token_scale: float = 1e-6

    def __post_init__(self) -> None:
        object.__setattr__(self, "key_layers", tuple(self.key_layers))
        _positive(self, "depth", "num_heads", "mlp_ratio", "num_registers")
        layers = self.key_layers
        if len(layers) != 4 or list(layers) != sorted(set(layers)) or layers[0] < 0 or layers[-1] >= self.depth:
            raise ValueError(
                f"AggregatorConfig.key_layers must be four increasing layer indices below depth={self.depth} "
                f"(the depth head reads four), got {layers}"
            )


@dataclasses.dataclass(frozen=True)
class CameraHeadConfig:
    """Iterative camera head; its width is twice the aggregator's.

    `initial_pose` is the encoding that the first round refines: zeros in VGGT; the identity with a mean field
    of view helps a model trained from nothing.
    """

    depth: int = 4
    num_heads: int = 16
    iterations: int = 4
    layer_scale: float = 0.01
    initial_pose: tuple[float, ...] = (0.0,) * 9

    def __post_init__(self) -> None:
        object.__setattr__(self, "initial_pose", tuple(float(x) for x in self.initial_pose))
        _positive(self, "depth", "num_heads", "iterations")
        if len(self.initial_pose) != 9:
            raise ValueError(f"CameraHeadConfig.initial_pose needs 9 numbers, got {len(self.initial_pose)}")


@dataclasses.dataclass(frozen=True)
class DPTConfig:
    """Dense prediction head over the four key layers."""

    features: int = 256
    out_channels: tuple[int, ...] = (256, 512, 1024, 1024)

    def __post_init__(self) -> None:
        object.__setattr__(self, "out_channels", tuple(self.out_channels))
        _positive(self, "features")
        if self.features % 8:
            raise ValueError(f"DPTConfig.features must be a multiple of 8 (uv embedding), got {self.features}")
        if len(self.out_channels) != 4 or any(c < 4 or c % 4 for c in self.out_channels):
            raise ValueError(
                f"DPTConfig.out_channels must be four positive multiples of 4 (uv embedding), got {self.out_channels}"
            )


@dataclasses.dataclass(frozen=True)
class WindowConfig:
    """Overlapping windows of `size` frames, `stride` apart (paper: K = 4, stride 2).

    `cross_window` switches cross-window attention; `cache` says which side of the key layers' global block the
    next window attends to.
    """

    size: int = 4
    stride: int = 2
    cross_window: bool = True
    cache: str = "output"

    def __post_init__(self) -> None:
        _positive(self, "size", "stride")
        if not self.stride < self.size:
            raise ValueError(
                f"WindowConfig.stride={self.stride} must be at least 1 and below size={self.size}: "
                "neighbouring windows share size - stride frames"
            )
        if self.cache not in ("output", "input"):
            raise ValueError(f"WindowConfig.cache must be 'output' or 'input', got {self.cache!r}")


@dataclasses.dataclass(frozen=True)
class RefinementConfig:
    """Global camera consistency refinement (GCCR) and the frames that the camera head sees.

    `enabled=False` leaves camera tokens as they are. `period=None` refines once at the end, `period=n` every n
    frames against the past only, freezing what was refined (online: the window stride). `context=None` lets the
    camera head's trunk see all frames, `context=m` frame 0 and the m frames up to the group being decoded.
    """

    enabled: bool = True
    period: int | None = None
    context: int | None = None
    num_heads: int = 16

    def __post_init__(self) -> None:
        _positive(self, "num_heads")
        for name in ("period", "context"):
            if getattr(self, name) is not None:
                _positive(self, name)


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The whole model. `dtype` is the compute type; parameters and the residual stream are float32 always.

    `attention` picks the back end: `auto` takes cuDNN flash attention on GPUs (bfloat16), the Pallas flash
    kernel on TPUs, and blockwise XLA elsewhere.
    """

    encoder: EncoderConfig = EncoderConfig()
    aggregator: AggregatorConfig = AggregatorConfig()
    camera_head: CameraHeadConfig = CameraHeadConfig()
    depth_head: DPTConfig = DPTConfig()
    point_head: DPTConfig | None = None
    windows: WindowConfig = WindowConfig()
    refinement: RefinementConfig = RefinementConfig()
    dtype: str = "float32"
    attention: str = "auto"

    def __post_init__(self) -> None:
        with contextlib.suppress(TypeError):  # what names no type is refused below
            object.__setattr__(self, "dtype", jnp.dtype(self.dtype).name)
        if self.dtype not in ("float32", "bfloat16", "float16"):
            raise ValueError(f"ModelConfig.dtype must be float32, bfloat16 or float16, got {self.dtype!r}")
        if self.attention not in ATTENTION_IMPLEMENTATIONS:
            raise ValueError(
                f"ModelConfig.attention must be one of {ATTENTION_IMPLEMENTATIONS}, got {self.attention!r}"
            )
        width = self.encoder.embed_dim
        _divides(self.aggregator, width, self.aggregator.num_heads, 4, "2-D rotary embedding")
        _divides(self.camera_head, 2 * width, self.camera_head.num_heads, 1, "one slice of channels a head")
        _divides(self.refinement, 2 * width, self.refinement.num_heads, 1, "one slice of channels a head")
        context, stride = self.refinement.context, self.windows.stride
        if context is not None and context < stride:
            raise ValueError(
                f"RefinementConfig.context={context} must be at least the window stride {stride}: poses are decoded "
                "in groups of one stride"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dict of JSON types, the form that checkpoints store."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> ModelConfig:
        """Inverse of `to_dict`; raises ValueError for an unknown field, naming it and the known ones."""
        return _from_dict(cls, values, "model")


def _from_dict(cls: Any, values: Any, path: str) -> Any:
    if not isinstance(values, dict):
        raise ValueError(f"{path} must be a mapping with the fields of {cls.__name__}, got {values!r}")
    hints = typing.get_type_hints(cls)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ValueError(f"unknown field {path}.{unknown[0]}; {cls.__name__} knows {', '.join(hints)}")
    arguments = {}
    for name, value in values.items():
        alternatives = _alternatives(hints[name])
        nested = [t for t in alternatives if dataclasses.is_dataclass(t)]
        if nested and not (value is None and types.NoneType in alternatives):
            value = _from_dict(nested[0], value, f"{path}.{name}")
        arguments[name] = value
    return cls(**arguments)


def _alternatives(hint: Any) -> tuple[Any, ...]:
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return typing.get_args(hint)
    return (hint,)
