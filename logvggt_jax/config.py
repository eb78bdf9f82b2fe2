"""Settings as frozen dataclasses: read from mappings, validated on construction, hashable; and the model's.

`from_mapping` and the `require_…` helpers serve the settings of the model, of training and of evaluation alike. The
model's defaults are VGGT-1B and the LoG-VGGT paper.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import numbers
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import ml_dtypes  # noqa: F401  (teaches numpy the name bfloat16)
import numpy as np

from logvggt_jax.errors import InputError

PATCH = 14
"""Pixels of a patch's side: edges of the model's images are multiples of it."""
ATTENTION_IMPLEMENTATIONS = ("auto", "xla", "cudnn", "tpu_flash")

Config = TypeVar("Config")


def from_mapping(cls: type[Config], values: Any, path: str) -> Config:
    """A dataclass from nested mappings, as configuration files and JSON hold them.

    Types are those of the fields: other dataclasses (from mappings), `X | None`, literals, numbers, strings, and
    tuples (from lists). A whole number is accepted as a float; True is no number. A tuple of dataclasses that have a
    `name` may be a mapping from names to the other fields, a tuple of pairs a mapping from firsts to seconds; both
    keep the order of the mapping.

    Args:
      cls: the dataclass.
      values: a mapping from its fields to values; fields with a default may be left out.
      path: what messages call the mapping, such as "config.optimizer"; "" for the outermost.

    Raises:
      InputError: An unknown or a missing field, a value of another type or out of range; one line that names the
        field by its path, and the fields there are.
    """
    if not isinstance(values, Mapping):
        raise InputError(f"{path} must be {_described(cls)}, got {values!r}")
    hints = typing.get_type_hints(cls)
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}  # type: ignore[arg-type]
    known = f"{cls.__name__} knows {', '.join(fields)}"
    for name in values:
        if name not in fields:
            similar = difflib.get_close_matches(str(name), fields, 1)
            guess = f" did you mean {similar[0]}?" if similar else ""
            raise InputError(f"unknown field {_joined(path, name)};{guess} {known}")
    for name, field in fields.items():
        optional = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
        if name not in values and not optional:
            raise InputError(f"missing field {_joined(path, name)}, {_described(hints[name])}; {known}")
    arguments = {name: typed(hints[name], value, _joined(path, name)) for name, value in values.items()}
    try:
        return cls(**arguments)
    except InputError as error:
        # A validator names class and field; whoever wrote the mapping knows the field by its path.
        prefix = f"{cls.__name__}."
        message = str(error)
        where = _joined(path, message.removeprefix(prefix)) if message.startswith(prefix) else f"{path}: {message}"
        raise InputError(where) from error


def to_mapping(config: Any) -> dict[str, Any]:
    """The inverse of `from_mapping`: a dataclass as nested dicts and lists, which JSON can hold."""
    mapping: dict[str, Any] = _plain(dataclasses.asdict(config))
    return mapping


def require_counts(config: Any, *names: str, least: int = 1) -> None:
    """Raises InputError unless these fields are whole numbers of at least `least`, or None where their type allows."""
    kind = "a positive integer" if least == 1 else f"an integer of at least {least}"
    for name in names:
        value = getattr(config, name)
        if value is None and _may_be_none(config, name):
            continue
        if not _is_number(value, numbers.Integral) or value < least:
            raise InputError(f"{type(config).__name__}.{name} must be {kind}, got {value!r}")


def require_within(config: Any, interval: str, *names: str) -> None:
    """Raises InputError unless these fields lie in an interval such as "[0, 1)" or "(0, inf)", or are None where their
    type allows."""
    low, high = (float(bound) for bound in interval[1:-1].split(","))
    for name in names:
        value = getattr(config, name)
        if value is None and _may_be_none(config, name):
            continue
        number = _is_number(value, numbers.Real)
        above = number and (value >= low if interval[0] == "[" else value > low)
        below = number and (value <= high if interval[-1] == "]" else value < high)
        if not (above and below):
            raise InputError(f"{type(config).__name__}.{name} must lie in {interval}, got {value!r}")


def require_one_of(config: Any, choices: Sequence[Any], *names: str) -> None:
    """Raises InputError unless these fields are one of the choices."""
    for name in names:
        value = getattr(config, name)
        if value not in choices:
            raise InputError(
                f"{type(config).__name__}.{name} must be one of {', '.join(map(repr, choices))}, got {value!r}"
            )


def _may_be_none(config: Any, name: str) -> bool:
    # A string where the module postpones annotations.
    return "None" in str(next(field.type for field in dataclasses.fields(config) if field.name == name))


def check_size(size: Sequence[int], what: str) -> None:
    """Raises InputError unless `size` is (H, W), pixels that images for the model can have; messages call it `what`."""
    if len(size) != 2 or not all(_is_number(edge, numbers.Integral) and _fills_patches(edge, PATCH) for edge in size):
        raise InputError(f"{what} must be (H, W), multiples of {PATCH} pixels, got {size!r}")


def check_longer_edge(longer_edge: int, what: str = "longer_edge", *, least: int = PATCH) -> None:
    """Raises InputError unless images for the model can have this longer edge; messages call it `what`."""
    if not _is_number(longer_edge, numbers.Integral) or not _fills_patches(longer_edge, least):
        raise InputError(f"{what} must be a multiple of {PATCH} pixels, at least {least}, got {longer_edge!r}")


def freeze_lists(config: Any) -> None:
    """Turns lists and numpy's values among the fields of a frozen dataclass into tuples and numbers of Python, so that
    it hashes and can be written as JSON; for `__post_init__`."""
    for field in dataclasses.fields(config):
        object.__setattr__(config, field.name, _frozen(getattr(config, field.name)))


def typed(hint: Any, value: Any, path: str) -> Any:
    """`value` as the type `hint`, of those that `from_mapping` reads; InputError, which calls it `path`, where it is
    another."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return _frozen(value)
    if origin in (typing.Union, types.UnionType):
        if value is None and types.NoneType in arguments:
            return None
        others = [other for other in arguments if other is not types.NoneType]
        if len(others) == 1 and (dataclasses.is_dataclass(others[0]) or typing.get_origin(others[0])):
            return typed(others[0], value, path)  # whose message says which part is wrong
        for other in others:
            with contextlib.suppress(InputError):
                return typed(other, value, path)
    elif dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return value if isinstance(value, hint) else from_mapping(hint, value, path)
    elif origin is tuple and arguments[-1] is Ellipsis and isinstance(value, Mapping):
        return _read_named(arguments[0], value, path)
    elif origin is tuple and isinstance(value, list | tuple):
        items = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else arguments
        if len(items) == len(value):
            return tuple(typed(items[i], part, f"{path}[{i}]") for i, part in enumerate(value))
    elif origin is not None and isinstance(origin, type) and issubclass(origin, Mapping):
        if isinstance(value, Mapping):
            return {key: typed(arguments[1], part, _joined(path, key)) for key, part in value.items()}
    elif origin is typing.Literal:
        if value in arguments:
            return value
    elif hint is float and _is_number(value, numbers.Real):
        return float(value)
    elif hint is int and _is_number(value, numbers.Integral):
        return int(value)
    elif origin is None and hint not in (int, float) and isinstance(value, hint):
        return value
    raise InputError(f"{path} must be {_described(hint)}, got {value!r}")


def _read_named(item: Any, values: Mapping[str, Any], path: str) -> tuple[Any, ...]:
    """A mapping as a tuple of dataclasses with a name, or of pairs."""
    if dataclasses.is_dataclass(item):
        for name, fields in values.items():
            if not isinstance(fields, Mapping):
                raise InputError(f"{_joined(path, name)} must be {_described(item)}, got {fields!r}")
        return tuple(typed(item, {"name": name, **fields}, _joined(path, name)) for name, fields in values.items())
    pair = typing.get_args(item)
    if typing.get_origin(item) is not tuple or len(pair) != 2 or Ellipsis in pair:
        raise InputError(f"{path} must be {_described(tuple[item, ...])}, got {values!r}")
    return tuple(
        (typed(pair[0], name, path), typed(pair[1], value, _joined(path, name))) for name, value in values.items()
    )


def _described(hint: Any) -> str:
    """A type in words."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    names = {int: "a whole number", float: "a number", str: "a string", bool: "True or False", types.NoneType: "None"}
    if hint in names:
        return names[hint]
    if dataclasses.is_dataclass(hint):
        return f"a mapping with the fields of {hint.__name__}"  # type: ignore[union-attr]
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_described(argument) for argument in arguments)
    if origin is typing.Literal:
        return f"one of {', '.join(map(repr, arguments))}"
    if origin is tuple and arguments[-1] is Ellipsis:
        return f"a list, each item {_described(arguments[0])}"
    if origin is tuple:
        return f"a list of {len(arguments)} items ({', '.join(_described(argument) for argument in arguments)})"
    return "a mapping" if origin is not None else f"of type {getattr(hint, '__name__', hint)}"


def _fills_patches(edge: int, least: int) -> bool:
    return edge >= least and edge % PATCH == 0


def _is_number(value: Any, kind: type) -> bool:
    return isinstance(value, kind) and not isinstance(value, bool)


def _joined(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _frozen(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    return tuple(_frozen(item) for item in value) if isinstance(value, list | tuple) else value


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _divides(config: Any, width: int, num_heads: int, multiple: int, why: str) -> None:
    if width % num_heads or (width // num_heads) % multiple:
        raise InputError(
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
    patch_size: int = PATCH
    frozen: bool = True

    def __post_init__(self) -> None:
        freeze_lists(self)
        require_counts(self, "embed_dim", "depth", "num_heads", "mlp_ratio", "num_registers", "position_grid")
        require_one_of(self, (PATCH,), "patch_size")  # images are prepared for no other
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

    @property
    def num_special(self) -> int:
        """Tokens of a frame before its patches: the camera token and the registers."""
        return 1 + self.num_registers

    def __post_init__(self) -> None:
        freeze_lists(self)
        require_counts(self, "depth", "num_heads", "mlp_ratio", "num_registers")
        require_within(self, "(0, inf)", "rope_base")
        require_within(self, "[0, inf)", "layer_scale", "token_scale")
        layers = self.key_layers
        if len(layers) != 4 or list(layers) != sorted(set(layers)) or layers[0] < 0 or layers[-1] >= self.depth:
            raise InputError(
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
        freeze_lists(self)
        require_counts(self, "depth", "num_heads", "iterations")
        require_within(self, "[0, inf)", "layer_scale")
        if len(self.initial_pose) != 9:
            raise InputError(f"CameraHeadConfig.initial_pose needs 9 numbers, got {len(self.initial_pose)}")


@dataclasses.dataclass(frozen=True)
class DPTConfig:
    """Dense prediction head over the four key layers."""

    features: int = 256
    out_channels: tuple[int, ...] = (256, 512, 1024, 1024)

    def __post_init__(self) -> None:
        freeze_lists(self)
        require_counts(self, "features")
        if self.features % 8:
            raise InputError(f"DPTConfig.features must be a multiple of 8 (uv embedding), got {self.features}")
        if len(self.out_channels) != 4 or any(c < 4 or c % 4 for c in self.out_channels):
            raise InputError(
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
        freeze_lists(self)
        require_counts(self, "size", "stride")
        if not self.stride < self.size:
            raise InputError(
                f"WindowConfig.stride={self.stride} must be at least 1 and below size={self.size}: "
                "neighbouring windows share size - stride frames"
            )
        require_one_of(self, ("output", "input"), "cache")


@dataclasses.dataclass(frozen=True)
class RefinementConfig:
    """Global camera consistency refinement (GCCR) and the frames that the camera head sees.

    `enabled=False` leaves camera tokens as they are. `period=None` refines once at the end, `period=n` every n
    frames against the past only, freezing what was refined (online: the window stride). `context=None` lets the
    camera head's trunk see all frames, `context=m` frame 0 and the m frames up to the group being decoded.
    `max_registers=None` lets GCCR read the registers of all frames, `max_registers=n` at most n register tokens (a
    frame has four): those of the first frame, of the newest, and of frames evenly between. With a period and a
    context besides, a stream costs the same at any length.
    """

    enabled: bool = True
    period: int | None = None
    context: int | None = None
    max_registers: int | None = None
    num_heads: int = 16

    def __post_init__(self) -> None:
        freeze_lists(self)
        require_counts(self, "period", "context", "max_registers", "num_heads")


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The whole model.

    `dtype` is the compute type; parameters as they are stored and drawn, and the residual stream, are float32.
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
            object.__setattr__(self, "dtype", np.dtype(self.dtype).name)
        require_one_of(self, ("float32", "bfloat16", "float16"), "dtype")
        require_one_of(self, ATTENTION_IMPLEMENTATIONS, "attention")
        width = self.encoder.embed_dim
        _divides(self.aggregator, width, self.aggregator.num_heads, 4, "2-D rotary embedding")
        _divides(self.camera_head, 2 * width, self.camera_head.num_heads, 1, "one slice of channels a head")
        _divides(self.refinement, 2 * width, self.refinement.num_heads, 1, "one slice of channels a head")
        context, stride = self.refinement.context, self.windows.stride
        if context is not None and context < stride:
            raise InputError(
                f"RefinementConfig.context={context} must be at least the window stride {stride}: poses are decoded "
                "in groups of one stride"
            )
        bound, a_frame = self.refinement.max_registers, self.aggregator.num_registers
        if bound is not None and bound < 2 * a_frame:
            raise InputError(
                f"RefinementConfig.max_registers={bound} must be at least {2 * a_frame}: GCCR keeps the {a_frame} "
                "registers of the first frame and those of the newest"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dict of JSON types, the form that checkpoints store."""
        return to_mapping(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ModelConfig:
        """Inverse of `to_dict`; InputError as `from_mapping`."""
        return from_mapping(cls, values, "model")
