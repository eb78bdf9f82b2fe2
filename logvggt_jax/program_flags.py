"""Flags of `train.py` and `eval.py`, whose mistakes are one line each."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable, Iterator

from absl import flags, logging
from ml_collections import config_flags

from logvggt_jax.errors import one_line, printable

# Of a configuration file that the library cannot open, between words on where it looked.
_NO_FILE = re.compile(r"Failed loading config file.*\[Errno \d+\] (?P<reason>[^:]+): '(?P<path>[^']*)'", re.DOTALL)
# What a configuration file of ours has against its argument, behind the library's words.
_OWN = re.compile(r"(?:logvggt_jax\.errors\.\w+|earlier failure to load): (?P<message>[^\n]+)\s*$")
# A field that is left out, whatever its type: the library reads numbers and tuples alone where those stand.
_LEFT_OUT = re.compile(r"--?config\.(?P<field>[^=]+)=None")
# The name of a field that is given; names that the library can read have parts joined by dots, or in brackets.
_GIVEN = re.compile(r"--?config\.(?P<field>[^=]*)")
_NAME = re.compile(r"""[^\W\d]\w*(\.[^\W\d]\w*|\[\d+\]|\['[^']*'\]|\["[^"]*"\])*""")
# What the library says at length of a field that is not there.
_ALL_FIELDS = re.compile(r' Other fields present: "\{.*\}"')
# In the words of absl, once for each flag.
_MISSING = re.compile(r"(--\w+) must have a value other than None")

# A flag belongs to the program that asks for it here, whose --help lists it.
flags.disclaim_key_flags()


def define_config(program: str, what: str) -> flags.FlagHolder:
    """The flag --config, for whose default the library reads the command line at once: a --flagfile in it may fail."""
    try:
        return config_flags.DEFINE_config_file("config", None, what, lock_config=True)
    except (flags.Error, OSError) as error:
        sys.exit(f"{program}: {_reason(error)}")


def flags_parser(program: str) -> Callable[[list[str]], list[str]]:
    """For `app.run`: reads flags as absl does, and returns the arguments that are none; a mistake ends `program`.

    `--config.FIELD=None` leaves a field out, of any type; it comes after what else is said of that field.
    """

    def parse(arguments: list[str]) -> list[str]:
        for found in filter(None, map(_GIVEN.match, arguments)):
            if not _NAME.fullmatch(found["field"]):
                mend = "a name has letters, digits and underscores, its parts are joined by dots"
                sys.exit(f"{program}: --config.{printable(found['field'])}: no field is named so; {mend}")
        left_out = [found["field"] for found in map(_LEFT_OUT.fullmatch, arguments) if found]
        try:
            with _command_line(_others(sys.argv)):
                rest = flags.FLAGS(_others(arguments))
            config = flags.FLAGS["config"].value
            is_mapping = hasattr(config, "to_dict")  # a file that cannot be loaded says so only now
            if is_mapping:
                config.update_from_flattened_dict(dict.fromkeys(left_out))
        except (AttributeError, LookupError, TypeError) as error:
            # The library wraps one error in the other, with quotes around quotes.
            reason = error.args[0] if error.args else error
            reason = reason.args[0] if isinstance(reason, KeyError) else reason
            words = _ALL_FIELDS.sub("", " ".join(str(reason).split()))
            sys.exit(f"{program}: --config has no such field: {words}")
        except (flags.Error, OSError) as error:
            sys.exit(f"{program}: {_reason(error)}")
        if not is_mapping:
            sys.exit(f"{program}: get_config of the --config file gives a {type(config).__name__}, not a ConfigDict")
        if flags.FLAGS["verbosity"].using_default_value:
            # Orbax reports every file at the level that absl's app would choose.
            flags.FLAGS.verbosity = logging.WARNING
        return list(rest)

    return parse


def _others(arguments: list[str]) -> list[str]:
    return [each for each in arguments if not _LEFT_OUT.fullmatch(each)]


@contextlib.contextmanager
def _command_line(arguments: list[str]) -> Iterator[None]:
    """Has these in `sys.argv`, where the library looks for the fields that are given, whatever it is told to parse."""
    whole, sys.argv = sys.argv, arguments
    try:
        yield
    finally:
        sys.argv = whole


def _reason(error: Exception) -> str:
    """An error in one line; of one that holds the traceback of a configuration file, what that ended with."""
    if missing := _MISSING.findall(str(error)):
        return f"missing: {', '.join(missing)}; --help says what each is"
    if found := _NO_FILE.search(str(error)):
        return f"--config={found['path']}: {found['reason']}"
    if own := _OWN.search(str(error)):
        return f"--config: {own['message']}"
    before, traceback, after = str(error).partition("Traceback (most recent call last):")
    return one_line(error) if not traceback else f"{before.split(chr(10))[0].strip()} {after.strip().splitlines()[-1]}"
