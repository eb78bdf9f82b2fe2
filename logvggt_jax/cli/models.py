"""`logvggt convert` and `info`: weights of others become a model folder, and what such a folder holds."""

from __future__ import annotations

import argparse
from typing import Any

from logvggt_jax.cli.command import add_command, given_path, overwrite_option


def _convert(options: argparse.Namespace) -> None:
    from logvggt_jax.compile import check_devices
    from logvggt_jax.weights.checkpoints import convert

    check_devices()
    report = convert(
        options.source,
        options.output,
        point_head=options.point_head,
        overwrite=options.overwrite,
        trained_for=options.trained_for,
    )
    if options.keys:
        for name in report.used:
            print(f"  used: {name} -> {', '.join(report.targets[name])}")
    for title, names in (("skipped", report.skipped), ("initialised", report.initialised)):
        for name in names:
            print(f"  {title}: {name}")
    print(f"model: {options.output}")


def _info(options: argparse.Namespace) -> None:
    from rich.console import Console

    from logvggt_jax.compile import check_devices
    from logvggt_jax.weights.checkpoints import load_model, read_provenance
    from logvggt_jax.weights.summary import model_summary, provenance_lines

    check_devices()
    model, variables = load_model(options.checkpoint)
    console = Console()
    console.print(model_summary(model.config, variables["params"]))
    console.print(provenance_lines(read_provenance(options.checkpoint)), highlight=False, markup=False, soft_wrap=True)
    console.print("every parameter is finite and equals the digest stored with it")


def add_to(commands: Any) -> None:
    """Adds the commands about models."""
    sub = add_command(
        commands,
        "convert",
        _convert,
        "turn a public VGGT checkpoint into a LoG-VGGT model folder",
        "logvggt convert facebook/VGGT-1B --output models/vggt-1b",
    )
    sub.add_argument(
        "source",
        help="VGGT checkpoint: a file of PyTorch or safetensors, its folder, or a hub repository, hf:OWNER/NAME[/FILE] "
        "or OWNER/NAME where no folder OWNER is here",
    )
    sub.add_argument("--output", type=given_path, required=True, metavar="DIR", help="model folder to make")
    sub.add_argument("--point-head", action="store_true", help="keep the point head")
    sub.add_argument(
        "--trained-for",
        choices=("vggt", "causal"),
        default="vggt",
        help="vggt: all frames at once. causal: each frame sees those before it, as StreamVGGT's checkpoints, whose "
        "names and shapes are VGGT's",
    )
    sub.add_argument(
        "--keys", action="store_true", help="list every tensor that is used and what it becomes, not the others alone"
    )
    overwrite_option(sub, "an earlier model folder")

    sub = add_command(
        commands,
        "info",
        _info,
        "sizes and parameters of a model folder, after a check of every stored digest",
        "logvggt info models/vggt-1b",
    )
    sub.add_argument(
        "checkpoint",
        help="model folder made by `logvggt convert`, folder of a training run, or `rooms`, the model that ships",
    )
