"""How a command is added to the command line, and the options that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from logvggt_jax.files import EMPTY_PATH

if TYPE_CHECKING:
    from logvggt_jax.model.logvggt import LogVGGT, Variables


def add_command(
    commands: Any,
    name: str,
    run: Callable[[argparse.Namespace], int | None],
    summary: str,
    example: str,
    *,
    details: str = "",
) -> argparse.ArgumentParser:
    """Adds a command to a group of them.

    Args:
      commands: what `ArgumentParser.add_subparsers` returned.
      name: of the command.
      run: takes the options and returns the exit code, None for 0.
      summary: what it does, in a few words that begin with a verb.
      example: a whole command line, shown by its help.
      details: sentences for its help, after a space.

    Returns:
      The command's parser, which its options are to be added to.
    """
    added = commands.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.{details}",
        epilog=f"example:\n  {example}",
        formatter_class=_Formatter,
    )
    added.set_defaults(run=run)
    added.add_argument("--traceback", action="store_true", help="show where in the code an error arose")
    return added


def given_path(text: str) -> Path:
    """For `type` of an option; an empty text would mean the current folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError(EMPTY_PATH)
    return Path(text)


def output_option(parser: argparse.ArgumentParser) -> None:
    """Adds the folder that a command makes."""
    parser.add_argument("--output", type=given_path, required=True, metavar="DIR", help="folder to make")


def overwrite_option(parser: argparse.ArgumentParser, what: str) -> None:
    """Adds the leave to replace what is there, for example "an earlier model folder"."""
    parser.add_argument("--overwrite", action="store_true", help=f"replace {what}")


def longer_edge_option(parser: argparse.ArgumentParser) -> None:
    """Adds the size of the images that the network sees."""
    parser.add_argument(
        "--longer-edge",
        type=int,
        default=None,
        metavar="PIXELS",
        help="resize frames so that their longer edge has this size, a multiple of 14 (default: the size that the "
        "model was trained with)",
    )


def calibration_options(parser: argparse.ArgumentParser) -> None:
    """`--intrinsics` and `--shared-intrinsics`: what is known of the camera."""
    known = parser.add_argument_group("camera").add_mutually_exclusive_group()
    known.add_argument(
        "--intrinsics",
        type=_pinhole,
        default=None,
        metavar="FX,FY,CX,CY",
        help="focal lengths and principal point of all frames where they are known, in pixels of the original images "
        "with centres at integers, instead of the model's",
    )
    known.add_argument(
        "--shared-intrinsics",
        action="store_true",
        help="all frames have one camera: take the median of the model's focal lengths for all",
    )


def execution_options(parser: argparse.ArgumentParser) -> None:
    """Adds how a network is computed, and where its compiled programs stay."""
    parser.add_argument(
        "--dtype", choices=("float32", "bfloat16"), default=None, help="compute type instead of the checkpoint's own"
    )
    parser.add_argument(
        "--precision",
        choices=("int8", "fp8"),
        default=None,
        help="large products of encoder and aggregator in eight bits, at some loss of accuracy (needs the extra "
        "`lowprecision`; `logvggt doctor --part precision` prints what is lost and gained)",
    )
    parser.add_argument(
        "--compilation-cache",
        default=None,
        metavar="DIR",
        help="where compiled programs are kept between runs, 'none' for nowhere (default: $JAX_COMPILATION_CACHE_DIR "
        "or the user's cache folder)",
    )


def loaded_model(checkpoint: str | Path, options: argparse.Namespace) -> tuple[LogVGGT, Variables]:
    """The model of a checkpoint, its parameters as `--dtype` and `--precision` of `execution_options` ask for them.

    They are cast here rather than in the stream alone, so that nothing keeps the float32 parameters on the device.
    """
    from logvggt_jax.model.low_precision import in_low_precision
    from logvggt_jax.model.parameters import in_compute_type
    from logvggt_jax.weights.checkpoints import from_pretrained

    model, variables = from_pretrained(checkpoint, dtype=options.dtype)
    if options.precision:
        variables = in_low_precision(variables, options.precision)
    return model, in_compute_type(variables, model.config)


class _Formatter(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Keeps the example's line and shows defaults that say something."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default is None or action.default is False or action.default == []:
            return action.help
        if isinstance(action.default, tuple):
            return f"{action.help} (default: {'x'.join(map(str, action.default))})"
        return super()._get_help_string(action)


def _pinhole(text: str) -> tuple[float, ...]:
    try:
        fx, fy, cx, cy = (float(number) for number in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected FX,FY,CX,CY such as 1400,1400,960,540, got {text!r}") from None
    return fx, fy, cx, cy
