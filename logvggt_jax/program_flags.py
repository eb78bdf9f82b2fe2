"""Flags of `train.py` and `eval.py`, whose mistakes are one line each."""

from __future__ import annotations

import sys
from collections.abc import Callable

from absl import flags, logging

from logvggt_jax.errors import one_line


def flags_parser(program: str) -> Callable[[list[str]], list[str]]:
    """For `app.run`: reads flags as absl does, and returns the arguments that are none; a mistake ends `program`."""

    def parse(arguments: list[str]) -> list[str]:
        try:
            rest = flags.FLAGS(arguments)
            flags.FLAGS["config"].value.to_dict()  # a file that cannot be loaded says so only now
        except (AttributeError, KeyError) as error:
            # The library wraps one error in the other, with quotes around quotes.
            reason = error.args[0] if error.args else error
            reason = reason.args[0] if isinstance(reason, KeyError) else reason
            sys.exit(f"{program}: --config has no such field: {' '.join(str(reason).split())}")
        except (flags.Error, OSError) as error:
            sys.exit(f"{program}: {one_line(error)}")
        if flags.FLAGS["verbosity"].using_default_value:
            # Orbax reports every file at the level that absl's app would choose.
            flags.FLAGS.verbosity = logging.WARNING
        return list(rest)

    return parse
