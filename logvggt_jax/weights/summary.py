"""A model in a few lines: sizes, parameters by part, memory."""

from typing import Any

import jax
from rich.table import Table

from logvggt_jax.config import ModelConfig
from logvggt_jax.errors import printable
from logvggt_jax.weights.provenance import Provenance


def model_summary(config: ModelConfig, params: dict[str, Any]) -> Table:
    """A table of a model's parts (`variables["params"]` by part) with their parameters and sizes."""
    windows, refinement = config.windows, config.refinement
    cross = f"cross-window attention to the {windows.cache}s" if windows.cross_window else "no cross-window attention"
    when = "at the end" if refinement.period is None else f"every {refinement.period} frames"
    context = "all frames" if refinement.context is None else f"frame 0 and {refinement.context} frames"
    descriptions = {
        "encoder": f"{config.encoder.depth} blocks, width {config.encoder.embed_dim}, patches of "
        f"{config.encoder.patch_size} pixels",
        "aggregator": f"{config.aggregator.depth} + {config.aggregator.depth} blocks, key layers "
        f"{', '.join(map(str, config.aggregator.key_layers))}; windows of {windows.size} frames, stride "
        f"{windows.stride}, {cross}",
        "camera_head": f"{config.camera_head.depth} blocks, {config.camera_head.iterations} rounds, sees {context}",
        "depth_head": f"{config.depth_head.features} features",
        "point_head": "" if config.point_head is None else f"{config.point_head.features} features",
        "gccr": f"refinement {when}" if refinement.enabled else "refinement off",
    }
    table = Table("part", "parameters", "MiB", "what", title=f"LoG-VGGT, computing in {config.dtype}")
    total = size = 0
    for part in sorted(params, key=list(descriptions).index):
        leaves = jax.tree.leaves(params[part])
        count, mebibytes = sum(x.size for x in leaves), sum(x.nbytes for x in leaves) / 2**20
        total, size = total + count, size + mebibytes
        table.add_row(part, f"{count:,}", f"{mebibytes:,.1f}", descriptions[part])
    table.add_row("all", f"{total:,}", f"{size:,.1f}", "", style="bold")
    return table


def provenance_lines(provenance: Provenance) -> str:
    """What the weights were trained for and where they come from, one line each."""
    purpose = {
        "windows": "windows (LoG-VGGT)",
        "vggt": "all frames at once (VGGT)",
        "causal": "each frame sees those before it (StreamVGGT)",
    }
    edge = provenance.longer_edge
    lines: dict[str, str | None] = {
        "trained for": purpose.get(provenance.trained_for or ""),
        "image size": f"longer edge {edge} pixels" if edge else None,
        "licence": provenance.licence,
        "source": provenance.source,
    }
    if training := provenance.training:
        lines |= {
            "trained by": training.command,
            "code": f"commit {training.commit}" if training.commit else None,
            "data": training.data,
            "steps": f"{training.steps:,}" if training.steps else None,
            "device": training.device,
            "time": f"{training.minutes:,.0f} minutes" if training.minutes else None,
        }
    return "\n".join(f"{title}: {printable(value or 'not recorded')}" for title, value in lines.items())
