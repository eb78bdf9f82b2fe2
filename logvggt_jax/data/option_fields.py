"""Options of a data set's reader as fields of a configuration, for flags to fill."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder

from logvggt_jax.data.registry import option_types


def option_fields(name: str, chosen: Mapping[str, Any]) -> ConfigDict:
    """The options of data set `name` as a configuration file holds them, so that each can be given on the command line.

    Args:
      name: of the data set.
      chosen: options and their values; they come first. None, as an unfilled placeholder reads, is no choice.

    Returns:
      What was chosen, and a placeholder for each of the others that is one number, string or truth value. None, as a
      placeholder reads until it is filled, leaves an option to the reader's default, see `given_options`.
    """
    fields = ConfigDict(given_options(chosen), sort_keys=False)
    for option, kind in option_types(name).items():
        if option not in fields and kind in (bool, int, float, str):
            fields[option] = placeholder(kind)
    return fields


def given_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options without those that a configuration leaves to the reader's default."""
    return {option: value for option, value in options.items() if value is not None}
