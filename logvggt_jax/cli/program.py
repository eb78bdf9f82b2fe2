"""The program: reads the command line, runs a command, and turns what ended it into an exit code."""

import argparse
import signal
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from logvggt_jax.cli import data, doctor, live, models, reconstruct, results
from logvggt_jax.cli.exit_codes import BAD_INPUT, OUTPUT_LOST
from logvggt_jax.errors import InputError, one_line
from logvggt_jax.interruption import INTERRUPTED, Interrupted, one_line_at_ctrl_c
from logvggt_jax.terminal import forgiving_streams, plain_warnings


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns the exit code.

    0; 2 for bad input; 128 and its number where a signal ended the run; 1 where `data check` or `doctor` found
    problems, or standard output could not be written. A reader of standard output that goes away is no error. Any
    exception but InputError is a fault of this package and passes through with its traceback.

    Args:
      arguments: without the program's name; default `sys.argv[1:]`.
    """
    with forgiving_streams() as output, one_line_at_ctrl_c("logvggt"):
        code = _run(sys.argv[1:] if arguments is None else arguments)
    if output.failure is not None and not isinstance(output.failure, BrokenPipeError):
        print(f"logvggt: error: standard output cannot be written: {one_line(output.failure)}", file=sys.stderr)
        return code or OUTPUT_LOST
    return code


def _run(arguments: Sequence[str]) -> int:
    parser = command_parser()
    options, unknown = parser.parse_known_args(with_dashes(arguments))
    if unknown:
        parser.error(f"unrecognized arguments: {' '.join(unknown)}{_unquoted(options, unknown)}")
    try:
        with plain_warnings("logvggt"):
            return options.run(options) or 0
    except KeyboardInterrupt:
        print("logvggt: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Interrupted as interruption:
        print(f"logvggt: ended by {interruption.signal}: {interruption}", file=sys.stderr)
        return 128 + signal.Signals[interruption.signal]
    except InputError as error:
        if options.traceback:
            traceback.print_exc()
        print(f"logvggt: error: {one_line(error)}", file=sys.stderr)
        return BAD_INPUT


def command_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line; the function that runs a command is the value of `run`."""
    parser = _Parser(
        prog="logvggt",
        description="LoG-VGGT in JAX: camera poses, depth and point clouds from image sequences of any length.",
        epilog="`logvggt COMMAND --help` shows a command's options and an example.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    parser.set_defaults(traceback=False)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for module in (models, reconstruct, live, results, data, doctor):
        module.add_to(commands)
    return parser


class _Parser(argparse.ArgumentParser):
    """Says in one line what is wrong; its commands are of this kind, too."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: error: {message}; `{self.prog} --help` tells how it is used\n")


def _unquoted(options: argparse.Namespace, unknown: Sequence[str]) -> str:
    """A remark where a shell has made files of a pattern, for a command that takes one."""
    if not hasattr(options, "pattern") or any(
        argument.startswith("-") or not _exists(argument) for argument in unknown
    ):
        return ""
    return "; one source is taken: put a pattern in quotes ('walk/*.jpg'), or give the folder"


def _exists(name: str) -> bool:
    try:
        return Path(name).exists()
    except OSError:  # too long to be a name
        return False


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"logvggt {version('logvggt-jax')}")
        parser.exit()


def with_dashes(arguments: Sequence[str]) -> list[str]:
    """Option names with underscores, as train.py and eval.py spell theirs, in the spelling with dashes."""
    result = []
    for argument in arguments:
        if argument.startswith("--"):
            name, equals, value = argument.partition("=")
            argument = name.replace("_", "-") + equals + value
        result.append(argument)
    return result
