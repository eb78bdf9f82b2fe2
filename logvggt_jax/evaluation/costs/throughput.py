"""What methods cost over sequences of several lengths: the paper's tables of cost, and those by length."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from logvggt_jax.evaluation.costs.parts import PARTS, sequence_parts, time_part
from logvggt_jax.evaluation.costs.streams import TimingConfig, measured_once
from logvggt_jax.evaluation.methods.method import Checkpoint, Method
from logvggt_jax.evaluation.methods.variants import VARIANTS, variant_methods
from logvggt_jax.evaluation.protocols.images import PrincipalPointCrop
from logvggt_jax.model.logvggt import LogVGGT

# Variants with GCCR once at the end and after every window, each with both trunks: the modes of the paper's tables.
_MODES = ("full", "gccr_online")


def measured_costs(
    rows: Sequence[Method],
    config: TimingConfig,
    output: Path,
    *,
    image_size: tuple[int, int],
    dtype: str,
    fresh: bool = False,
) -> dict[str, Any]:
    """The costs of rows that have predictors, all in one run.

    `image_size` is (H, W) of the pictures, `dtype` the compute type of the model, recorded; the other arguments are
    those of `measured_once`. Returns what it gives, with `dtype`, `image_size` and `costs` (by row and length, as
    `cost_of_length` gives them).
    """
    setting = {"dtype": dtype, "image_size": list(image_size)}
    return measured_once(rows, config, output, setting, lambda costs: {"costs": costs}, fresh=fresh)


def measured_timings(
    checkpoint: Checkpoint,
    references: Sequence[Method],
    config: TimingConfig,
    output: Path,
    *,
    longer_edge: int,
    fresh: bool = False,
) -> dict[str, Any]:
    """Frames a second of the model and its references by length, and the time by part of the longest sequence.

    Args:
      checkpoint: the model; its mode of refinement is replaced by each of the paper's.
      references: other rows, by their predictors. A length that one of them cannot take has the reason in place of
        its rates.
      config, output, fresh: see `measured_once`.
      longer_edge: pixels; pictures are 4 : 3, as the cameras of the paper's benchmarks are.

    Returns:
      What `measured_once` gives, with `dtype`, `image_size`, `windows`, `frames_per_second` (by row and length a list
      of rates, or the reason why there are none), `part_frames` and `parts` (`name`, `seconds`) with GCCR once at the
      end.
    """
    base = checkpoint.model.config
    image_size = PrincipalPointCrop(longer_edge).size((3, 4))
    windows = [base.windows.size, base.windows.stride]

    def with_parts(costs: dict[str, dict[str, Any]]) -> dict[str, Any]:
        parts = sequence_parts(LogVGGT(VARIANTS["full"].config(base)), config.lengths[-1], image_size)
        times = [time_part(part, checkpoint.variables, rounds=config.rounds) for part in parts]
        return {
            "frames_per_second": {
                name: {length: cost.get("frames_per_second", cost.get("reason")) for length, cost in by_length.items()}
                for name, by_length in costs.items()
            },
            "part_frames": config.lengths[-1],
            "parts": [
                {"name": name, "seconds": sum(t.calls * t.median for t in times if t.name == name)} for name in PARTS
            ],
        }

    rows = [*variant_methods(checkpoint, _MODES), *references]
    setting = {"dtype": base.dtype, "image_size": list(image_size), "windows": windows}
    return measured_once(rows, config, output, setting, with_parts, fresh=fresh)
