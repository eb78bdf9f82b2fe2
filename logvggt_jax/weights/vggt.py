"""VGGT's PyTorch parameters, names and layouts, as this package's parameter tree.

`vggt_rules` is the one table: every tensor of a VGGT state dict, the shape PyTorch gives it, and the parameters
made from it. Source: the VGGT-1B checkpoint (1797 tensors).
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.config import (
    AggregatorConfig,
    CameraHeadConfig,
    DPTConfig,
    EncoderConfig,
    ModelConfig,
    RefinementConfig,
)
from logvggt_jax.errors import InputError
from logvggt_jax.model.initialization import shallow, variable_shapes
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.weights.digests import non_finite
from logvggt_jax.weights.lazy import Header, LazyTensors

ParamPath = tuple[str, ...]
Layout = Callable[[np.ndarray], np.ndarray]
_CONV = functools.partial(np.transpose, axes=(2, 3, 1, 0))
_TRANSPOSED_CONV = functools.partial(np.transpose, axes=(2, 3, 0, 1))

_OUTPUT_HIDDEN = 32  # width between the two convolutions of the DPT head's output, in every VGGT
_DTYPES = ("float32", "float16", "bfloat16", "float64")
# How many blocks a whole checkpoint has at least, by the encoder's width: in the encoder, as DINOv2 was published, and
# in the camera head, which is known of VGGT-1B alone.
_DINOV2_DEPTHS = {384: 12, 768: 12, 1024: 24, 1536: 40}
_TRUNK_DEPTHS = {1024: 4}
# Constants that some checkpoints hold, and the one parameter that only training used.
_BUFFERS = ("aggregator._resnet_mean", "aggregator._resnet_std")
_MASK_TOKEN = "aggregator.patch_embed.mask_token"
# The fields of the configuration that the shapes of tensors tell.
_SIZES = {
    "encoder": ("embed_dim", "depth", "mlp_ratio", "num_registers", "position_grid", "patch_size"),
    "aggregator": ("depth", "num_heads", "mlp_ratio", "num_registers"),
    "camera_head": ("depth",),
    "depth_head": ("features", "out_channels"),
    "point_head": ("features", "out_channels"),
}


@dataclasses.dataclass(frozen=True)
class Rule:
    """One tensor of the PyTorch state dict."""

    name: str  # Its name there
    shape: tuple[int, ...]  # Its shape there
    # The parameters made from it: path in our tree, and the change of layout.
    targets: tuple[tuple[ParamPath, Layout], ...]


@dataclasses.dataclass
class ConversionReport:
    """What became of each name.

    Attributes:
      used: PyTorch names whose tensors went into the parameters.
      skipped: PyTorch names left out: the track head, the point head where the configuration has none, constants.
      targets: For each used name the paths (`gccr/query/kernel`) of the parameters that were made from it.
      initialised: Paths of parameters that VGGT does not have, and of DINOv2's mask token, which
        nothing reads, where the file lacks it.
    """

    used: list[str] = dataclasses.field(default_factory=list)
    skipped: list[str] = dataclasses.field(default_factory=list)
    targets: dict[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    initialised: list[str] = dataclasses.field(default_factory=list)


def _first_third(x: np.ndarray) -> np.ndarray:
    return x[: len(x) // 3].T


def _other_thirds(x: np.ndarray) -> np.ndarray:
    return x[len(x) // 3 :].T


def _raw(name: str, path: ParamPath, *shape: int) -> Iterator[Rule]:
    yield Rule(name, shape, ((path, np.asarray),))


def _norm(name: str, path: ParamPath, width: int) -> Iterator[Rule]:
    yield from _raw(f"{name}.weight", (*path, "scale"), width)
    yield from _raw(f"{name}.bias", (*path, "bias"), width)


def _linear(name: str, path: ParamPath, inputs: int, outputs: int) -> Iterator[Rule]:
    yield Rule(f"{name}.weight", (outputs, inputs), (((*path, "kernel"), np.transpose),))
    yield from _raw(f"{name}.bias", (*path, "bias"), outputs)


def _conv(name: str, path: ParamPath, inputs: int, outputs: int, size: int, *, bias: bool = True) -> Iterator[Rule]:
    yield Rule(f"{name}.weight", (outputs, inputs, size, size), (((*path, "kernel"), _CONV),))
    if bias:
        yield from _raw(f"{name}.bias", (*path, "bias"), outputs)


def _transposed_conv(name: str, path: ParamPath, width: int, size: int) -> Iterator[Rule]:
    yield Rule(f"{name}.weight", (width, width, size, size), (((*path, "kernel"), _TRANSPOSED_CONV),))
    yield from _raw(f"{name}.bias", (*path, "bias"), width)


def _block(name: str, path: ParamPath, width: int, mlp_ratio: int, head_norm: int | None = None) -> Iterator[Rule]:
    """A transformer block; `head_norm` is the head size where queries and keys are normalised."""
    attention = (*path, "attention")
    yield from _norm(f"{name}.norm1", (*path, "norm1"), width)
    # Rows of the fused projection: queries of all heads, then keys, then values.
    for leaf, ours, shape in (("weight", "kernel", (3 * width, width)), ("bias", "bias", (3 * width,))):
        targets = (((*attention, "query", ours), _first_third), ((*attention, "key_value", ours), _other_thirds))
        yield Rule(f"{name}.attn.qkv.{leaf}", shape, targets)
    if head_norm is not None:
        yield from _norm(f"{name}.attn.q_norm", (*attention, "query_norm"), head_norm)
        yield from _norm(f"{name}.attn.k_norm", (*attention, "key_norm"), head_norm)
    yield from _linear(f"{name}.attn.proj", (*attention, "output"), width, width)
    yield from _raw(f"{name}.ls1.gamma", (*path, "scale1", "gamma"), width)
    yield from _norm(f"{name}.norm2", (*path, "norm2"), width)
    yield from _linear(f"{name}.mlp.fc1", (*path, "mlp", "fc1"), width, mlp_ratio * width)
    yield from _linear(f"{name}.mlp.fc2", (*path, "mlp", "fc2"), mlp_ratio * width, width)
    yield from _raw(f"{name}.ls2.gamma", (*path, "scale2", "gamma"), width)


def _encoder(config: EncoderConfig) -> Iterator[Rule]:
    """DINOv2: special tokens, position embedding, patch embedding, blocks, last norm."""
    name, path, width = "aggregator.patch_embed", ("encoder",), config.embed_dim
    yield from _raw(f"{name}.cls_token", (*path, "cls_token"), 1, 1, width)
    yield from _raw(f"{name}.pos_embed", (*path, "pos_embed"), 1, 1 + config.position_grid**2, width)
    yield from _raw(f"{name}.register_tokens", (*path, "register_tokens"), 1, config.num_registers, width)
    yield from _raw(f"{name}.mask_token", (*path, "mask_token"), 1, width)
    yield from _conv(f"{name}.patch_embed.proj", (*path, "patch_embed"), 3, width, config.patch_size)
    for i in range(config.depth):
        yield from _block(f"{name}.blocks.{i}", (*path, f"block_{i}"), width, config.mlp_ratio)
    yield from _norm(f"{name}.norm", (*path, "norm"), width)


def _aggregator(config: AggregatorConfig, width: int) -> Iterator[Rule]:
    """The trunk: special tokens, and the blocks over frames and over windows."""
    name, path = "aggregator", ("aggregator",)
    yield from _raw(f"{name}.camera_token", (*path, "camera_token"), 1, 2, 1, width)
    yield from _raw(f"{name}.register_token", (*path, "register_token"), 1, 2, config.num_registers, width)
    head = width // config.num_heads
    for kind in ("frame", "global"):
        for i in range(config.depth):
            block = (*path, f"{kind}_block_{i}")
            yield from _block(f"{name}.{kind}_blocks.{i}", block, width, config.mlp_ratio, head)


def _camera_head(config: CameraHeadConfig, width: int) -> Iterator[Rule]:
    """The camera head: trunk, adaptive norm, and what embeds and corrects a pose."""
    name, path = "camera_head", ("camera_head",)
    yield from _raw(f"{name}.empty_pose_tokens", (*path, "empty_pose_tokens"), 1, 1, 9)
    for i in range(config.depth):
        yield from _block(f"{name}.trunk.{i}", (*path, f"trunk_{i}"), width, 4)
    for norm in ("token_norm", "trunk_norm"):
        yield from _norm(f"{name}.{norm}", (*path, norm), width)
    yield from _linear(f"{name}.embed_pose", (*path, "embed_pose"), 9, width)
    yield from _linear(f"{name}.poseLN_modulation.1", (*path, "modulation"), width, 3 * width)
    yield from _linear(f"{name}.pose_branch.fc1", (*path, "pose_branch", "fc1"), width, width // 2)
    yield from _linear(f"{name}.pose_branch.fc2", (*path, "pose_branch", "fc2"), width // 2, 9)


def _dpt_head(head: str, config: DPTConfig, width: int, outputs: int) -> Iterator[Rule]:
    path, features, channels = (head,), config.features, config.out_channels
    yield from _norm(f"{head}.norm", (*path, "norm"), width)
    for i, out in enumerate(channels):
        yield from _conv(f"{head}.projects.{i}", (*path, f"project_{i}"), width, out, 1)
    yield from _transposed_conv(f"{head}.resize_layers.0", (*path, "resize_0"), channels[0], 4)
    yield from _transposed_conv(f"{head}.resize_layers.1", (*path, "resize_1"), channels[1], 2)
    yield from _conv(f"{head}.resize_layers.3", (*path, "resize_3"), channels[3], channels[3], 3)
    for i, out in enumerate(channels, start=1):
        yield from _conv(f"{head}.scratch.layer{i}_rn", (*path, f"layer_{i}"), out, features, 3, bias=False)
    for i in range(1, 5):
        name, fusion = f"{head}.scratch.refinenet{i}", (*path, f"refine_{i}")
        yield from _conv(f"{name}.out_conv", (*fusion, "output"), features, features, 1)
        # The coarsest level has nothing to add its own features to, hence no first residual unit.
        for unit in (1, 2) if i < 4 else (2,):
            for conv in ("conv1", "conv2"):
                target = (*fusion, f"residual_{unit}", conv)
                yield from _conv(f"{name}.resConfUnit{unit}.{conv}", target, features, features, 3)
    half = features // 2
    yield from _conv(f"{head}.scratch.output_conv1", (*path, "output_1"), features, half, 3)
    yield from _conv(f"{head}.scratch.output_conv2.0", (*path, "output_2_hidden"), half, _OUTPUT_HIDDEN, 3)
    yield from _conv(f"{head}.scratch.output_conv2.2", (*path, "output_2"), _OUTPUT_HIDDEN, outputs, 1)


def vggt_rules(config: ModelConfig) -> list[Rule]:
    """Every VGGT tensor that a model of this configuration uses, in the order of VGGT's modules."""
    width = 2 * config.encoder.embed_dim
    rules = [
        *_aggregator(config.aggregator, config.encoder.embed_dim),
        *_encoder(config.encoder),
        *_camera_head(config.camera_head, width),
        *_dpt_head("depth_head", config.depth_head, width, 2),
    ]
    if config.point_head is not None:
        rules += _dpt_head("point_head", config.point_head, width, 4)
    return rules


def check_vggt(state_dict: Mapping[str, np.ndarray], config: ModelConfig) -> None:
    """Compares a state dict with what a model of this configuration uses: names, and shapes and types as far as they
    are known without reading tensors. Raises InputError as `params_from_vggt`.
    """
    rules = vggt_rules(config)
    known = {rule.name for rule in rules}
    heads = _BUFFERS + (("track_head.",) if config.point_head is not None else ("track_head.", "point_head."))
    unknown = [name for name in state_dict if name not in known and not name.startswith(heads)]
    if unknown:
        others = f" and {len(unknown) - 1} others" if len(unknown) > 1 else ""
        raise InputError(
            f"unknown key {unknown[0]!r}{others} in the state dict, expected those of VGGT's aggregator, camera_head, "
            f"depth_head, point_head and track_head{_differences(state_dict, config)}"
        )
    present = set(state_dict)  # a lazy mapping may read a tensor to say whether it is there
    missing = [rule.name for rule in rules if rule.name not in present and rule.name != _MASK_TOKEN]
    if missing:
        differences, seen = _differences(state_dict, config), _seen(state_dict)
        # That sizes cannot be told for want of a key says what this line says.
        differences = "" if differences.endswith(seen) else differences
        raise InputError(
            f"{len(missing)} of {len(rules)} keys are missing from the state dict, first {', '.join(missing[:3])}"
            f"{differences}; {seen}"
        )
    for rule in rules:
        if rule.name in present and (header := _header(state_dict, rule.name)) is not None:
            _check_header(rule, header, state_dict, config)


def params_from_vggt(
    state_dict: Mapping[str, np.ndarray], config: ModelConfig
) -> tuple[dict[str, Any], ConversionReport]:
    """Parameters of a model of the given configuration from a VGGT state dict.

    Parameters that VGGT lacks (GCCR) are drawn as `LogVGGT.init` draws them from a fixed seed; GCCR's output
    projection is zero there, so that the network equals VGGT.

    Args:
      state_dict: PyTorch names to arrays in PyTorch layouts, floating point of any width. Each is read once, so a
        lazy mapping never holds two copies of the weights; what its headers tell is checked before.
      config: Sizes of the model; `config_from_vggt` reads them off a state dict.

    Returns:
      The parameter tree (float32, on the default device) and the report of names.

    Raises:
      InputError: A name is unknown or missing, or a tensor has another shape, is not floating point, or holds NaN or
        infinite values.
    """
    check_vggt(state_dict, config)
    rules = vggt_rules(config)
    known = {rule.name for rule in rules}
    present = set(state_dict)
    report = ConversionReport(skipped=[name for name in state_dict if name not in known])
    params: dict[str, Any] = {}
    for rule in rules:
        if rule.name not in present:
            continue
        tensor = np.asarray(state_dict[rule.name])
        _check_header(rule, Header(tensor.shape, tensor.dtype.name), state_dict, config)
        if wide := _too_large(tensor):
            raise InputError(f"{rule.name} has {wide}")
        tensor = tensor.astype(np.float32, copy=False)
        if wrong := non_finite(tensor):
            raise InputError(f"{rule.name} has {wrong}; the checkpoint is of a training that failed, or damaged")
        for path, layout in rule.targets:
            # A copy, because a view would keep the caller's array alive and follow its changes.
            _insert(params, path, jax.device_put(np.array(layout(tensor))))
        report.used.append(rule.name)
        report.targets[rule.name] = tuple("/".join(path) for path, _ in rule.targets)
    for path, value in _initial(config, params).items():
        _insert(params, path, value)
        report.initialised.append("/".join(path))
    return params, report


def config_from_vggt(state_dict: Mapping[str, np.ndarray], *, point_head: bool = False) -> ModelConfig:
    """Sizes of the VGGT that a state dict holds, with the paper's windows and refinement.

    Widths, depths, registers and the patch size are read off shapes. What shapes do not tell is taken from VGGT:
    encoder, aggregator and camera head have equally many attention heads (the aggregator's query norm has the size of
    one head: 1024 / 64 = 16 heads in VGGT-1B); the key layers are (4, 11, 17, 23), for which the aggregator must have
    24 layers; the camera head runs 4 rounds.

    Args:
      state_dict: PyTorch names to arrays; a dozen small ones are read where there are no headers.
      point_head: Whether the model gets the point head, which the checkpoint then has to hold.

    Raises:
      InputError: A tensor that tells a size or a block in between is missing, a tensor has another rank, or a depth is
        not that of VGGT or DINOv2; with some of the names that there are.
    """

    def shape(name: str, rank: int) -> tuple[int, ...]:
        if name not in state_dict:
            raise InputError(f"the state dict lacks {name}, which VGGT has; {_seen(state_dict)}")
        found = _shape(state_dict, name)
        if 0 in found:
            raise InputError(
                f"{name} is empty, as in one process's share of a training in shards; make one file of all shares, "
                "as DeepSpeed's zero_to_fp32.py does"
            )
        if len(found) != rank:
            raise InputError(f"{name} has shape {found}, VGGT's has {rank} axes")
        return found

    def count(prefix: str, expected: int | None = None) -> int:
        parts = {name[len(prefix) :].split(".", 1)[0] for name in state_dict if name.startswith(prefix)}
        indices = {int(part) for part in parts if part.isdecimal()}
        wanted = max(max(indices, default=0) + 1, expected or 0)
        if missing := sorted(set(range(wanted)) - indices):
            raise InputError(
                f"the state dict lacks {', '.join(f'{prefix}{i}' for i in missing[:4])}: it has {len(indices)} blocks "
                f"{prefix}*, expected {wanted}; {_seen(state_dict)}"
            )
        return wanted

    def dpt(head: str) -> DPTConfig:
        channels = tuple(shape(f"{head}.projects.{i}.bias", 1)[0] for i in range(4))
        return DPTConfig(shape(f"{head}.scratch.output_conv1.weight", 4)[1], channels)

    encoder, frame = "aggregator.patch_embed", "aggregator.frame_blocks"
    embed_dim = shape("aggregator.camera_token", 4)[3]
    positions = shape(f"{encoder}.pos_embed", 3)[1] - 1
    grid = round(positions**0.5)
    if grid * grid != positions:
        raise InputError(f"{encoder}.pos_embed holds {positions} grid positions, expected a square number")
    depth = count(f"{frame}.", count("aggregator.global_blocks."))
    count("aggregator.global_blocks.", depth)
    if depth != 24:
        raise InputError(
            f"the state dict has {depth} aggregator blocks of each kind, VGGT has 24: the key layers are unknown; "
            "build a ModelConfig with aggregator.key_layers and call params_from_vggt"
        )
    num_heads = embed_dim // shape(f"{frame}.0.attn.q_norm.weight", 1)[0]
    return ModelConfig(
        encoder=EncoderConfig(
            embed_dim=embed_dim,
            depth=count(f"{encoder}.blocks.", _DINOV2_DEPTHS.get(embed_dim)),
            num_heads=num_heads,
            mlp_ratio=shape(f"{encoder}.blocks.0.mlp.fc1.bias", 1)[0] // embed_dim,
            num_registers=shape(f"{encoder}.register_tokens", 3)[1],
            position_grid=grid,
            patch_size=shape(f"{encoder}.patch_embed.proj.weight", 4)[2],
        ),
        aggregator=AggregatorConfig(
            depth=depth,
            num_heads=num_heads,
            mlp_ratio=shape(f"{frame}.0.mlp.fc1.bias", 1)[0] // embed_dim,
            num_registers=shape("aggregator.register_token", 4)[2],
        ),
        camera_head=CameraHeadConfig(
            depth=count("camera_head.trunk.", _TRUNK_DEPTHS.get(embed_dim)), num_heads=num_heads
        ),
        depth_head=dpt("depth_head"),
        point_head=dpt("point_head") if point_head else None,
        refinement=RefinementConfig(num_heads=num_heads),
    )


def _header(state_dict: Mapping[str, np.ndarray], name: str) -> Header | None:
    """What is known of a tensor without reading it; of a mapping of some other kind, which may be lazy too, nothing."""
    if isinstance(state_dict, LazyTensors):
        return state_dict.header(name)
    if isinstance(state_dict, dict):
        tensor = np.asarray(state_dict[name])
        return Header(tensor.shape, tensor.dtype.name)
    return None


def _shape(state_dict: Mapping[str, np.ndarray], name: str) -> tuple[int, ...]:
    header = _header(state_dict, name)
    return np.shape(state_dict[name]) if header is None else header.shape


def _check_header(rule: Rule, header: Header, state_dict: Mapping[str, np.ndarray], config: ModelConfig) -> None:
    if header.shape != rule.shape:
        raise InputError(
            f"{rule.name} has shape {header.shape}, expected {rule.shape}{_differences(state_dict, config)}"
        )
    if header.dtype not in _DTYPES:
        raise InputError(f"{rule.name} is {header.dtype}, expected one of {', '.join(_DTYPES)}")


def _seen(state_dict: Mapping[str, np.ndarray]) -> str:
    """Some names of a state dict with their shapes, for the end of an error's line."""
    origin = getattr(state_dict, "origin", None)
    some = []
    for name in list(state_dict)[:3]:
        try:
            some.append(f"{name} {_shape(state_dict, name)}")
        except InputError:  # damage that has no part in the error at hand
            some.append(name)
    where = f"{origin} holds" if origin else "it holds"
    return f"{where} {len(state_dict)} tensors, {', '.join(some) or 'none'}{', …' if len(state_dict) > 3 else ''}"


def parameter_shapes(config: ModelConfig) -> dict[str, Any]:
    """The parameter tree as `jax.ShapeDtypeStruct`s placed on the default device, nothing computed."""
    sharding = jnp.zeros(()).sharding
    shapes: dict[str, Any] = variable_shapes(config)["params"]
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), shapes)


def _differences(state_dict: Mapping[str, np.ndarray], config: ModelConfig) -> str:
    """How the configuration's sizes differ from those the state dict shows, as the end of an error's line."""
    try:
        found = config_from_vggt(state_dict, point_head=config.point_head is not None)
    except InputError as error:
        return f"; {error}"
    texts = []
    for part, fields in _SIZES.items():
        theirs, ours = getattr(found, part), getattr(config, part)
        for field in fields if theirs is not None and ours is not None else ():
            here, there = getattr(ours, field), getattr(theirs, field)
            if here != there:
                texts.append(f"{part}.{field} is {here}, the state dict's {there}")
    return f"; in the configuration {'; '.join(texts)}" if texts else "; the file is damaged or another model's"


def _insert(tree: dict[str, Any], path: ParamPath, value: jax.Array) -> None:
    for key in path[:-1]:
        tree = tree.setdefault(key, {})
    tree[path[-1]] = value


def _initial(config: ModelConfig, params: dict[str, Any]) -> dict[ParamPath, jax.Array]:
    """Initial values of the model's parameters that `params` lacks, which are none of a layer's."""
    known = frozenset(_path(path) for path, _ in jax.tree_util.tree_leaves_with_path(params))
    every = (_path(path) for path, _ in jax.tree_util.tree_leaves_with_path(variable_shapes(config)["params"]))
    modules = {path[0] for path in every if path not in known}
    drawn = LogVGGT(shallow(config)).init(jax.random.key(0), _smallest_images(config), only=modules)["params"]
    leaves = {_path(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(drawn)}
    return {path: leaf for path, leaf in leaves.items() if path not in known}


def _smallest_images(config: ModelConfig) -> jax.Array:
    return jax.device_put(np.zeros((1, 1, config.encoder.patch_size, config.encoder.patch_size, 3), np.uint8))


def _path(path: Any) -> ParamPath:
    return tuple(key.key for key in path)


def _too_large(array: np.ndarray) -> str | None:
    """What to say of finite numbers that float32 has no place for; None where there are none."""
    if array.dtype.itemsize <= np.dtype(np.float32).itemsize or not array.size:
        return None
    sizes = np.abs(array, where=np.isfinite(array), out=np.zeros_like(array))
    if sizes.max() <= np.finfo(np.float32).max:
        return None
    return f"numbers up to {sizes.max():.3g}, too large for float32: no network has such weights, is the file damaged?"
