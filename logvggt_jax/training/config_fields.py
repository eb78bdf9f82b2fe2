"""Configurations of which every field can be changed on the command line."""

from __future__ import annotations

import dataclasses
import types
import typing
from typing import Any

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder

from logvggt_jax.data.option_fields import option_fields
from logvggt_jax.data.registry import DATASETS
from logvggt_jax.training.config import SourceConfig, TrainConfig


def with_all_fields(config: ConfigDict) -> ConfigDict:
    """`config`, a run's settings as files under `configs/` write them, with the fields that it leaves out.

    They have their defaults; where that is None a placeholder of the field's type stands, which a flag can fill. Parts
    that a run may do without (a teacher, colour augmentation, a point head) are not added.
    """
    _complete(config, TrainConfig)
    return config


def _complete(config: ConfigDict, cls: Any) -> None:
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        kind = _without_none(hints[field.name])
        if field.name in config:
            _complete_value(config, field.name, kind)
        elif field.init and field.name != "name":
            default = field.default_factory() if callable(field.default_factory) else field.default
            if dataclasses.is_dataclass(default):
                config[field.name] = _mapping_of(default)
                _complete(config[field.name], type(default))
            elif default is None:
                _hold_a_place(config, field.name, kind)
            elif default is not dataclasses.MISSING:
                config[field.name] = default


def _complete_value(config: ConfigDict, name: str, kind: Any) -> None:
    """What a field of this type holds, of which parts may be left out."""
    value = config[name]
    if isinstance(value, ConfigDict) and dataclasses.is_dataclass(kind):
        _complete(value, kind)
    elif isinstance(value, ConfigDict) and typing.get_origin(kind) is tuple:
        item = typing.get_args(kind)[0]
        for part, each in value.items():
            if dataclasses.is_dataclass(item) and isinstance(each, ConfigDict):
                _complete(each, item)
            if item is SourceConfig and part in DATASETS and (options := option_fields(part, dict(each.options))):
                del each.options  # of another type where the set has none
                each.options = options
    elif value is None:
        _hold_a_place(config, name, kind)


def _mapping_of(default: Any) -> ConfigDict:
    """A dataclass that is a default, whose fields may have other values than its class gives them."""
    values = {field.name: getattr(default, field.name) for field in dataclasses.fields(default) if field.init}
    return ConfigDict({name: _mapping_of(x) if dataclasses.is_dataclass(x) else x for name, x in values.items()})


def _hold_a_place(config: ConfigDict, name: str, kind: Any) -> None:
    kind = typing.get_origin(kind) or kind
    if kind in (bool, int, float, str, tuple):
        config[name] = placeholder(kind)


def _without_none(hint: Any) -> Any:
    """X of `X | None`; any other type as it is."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        others = [each for each in typing.get_args(hint) if each is not types.NoneType]
        return others[0] if len(others) == 1 else hint
    return hint
