"""Short clips with all metrics, of any data set at one small size: the benchmark of small models."""

import dataclasses

from logvggt_jax.config import check_size, require_counts, require_within
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.protocols.frame_selection import Clips
from logvggt_jax.evaluation.protocols.images import Fit
from logvggt_jax.evaluation.protocols.protocol import DepthMeasure, PointsMeasure, Protocol


@dataclasses.dataclass(frozen=True)
class ClipSettings:
    """Which clips are cut and how they are compared (`evaluation` in configs/eval/rooms.py and its like)."""

    # (H, W) of the model's input, multiples of 14; frames are resized and cropped to it. None: 3:4, as large as the
    # images that the checkpoint was trained on.
    image_size: tuple[int, int] | None
    clip_lengths: tuple[int, ...]  # frames of a clip
    stride: int = 1  # frames of the sequence from one frame of a clip to the next
    clips_per_sequence: int = 1  # clips with evenly spaced starts in each sequence
    max_sequences: int | None = None  # only that many first sequences; None takes all
    sets: int = 1  # of sequences, dealt round; from two on, tables show the standard deviation of the sets' means
    # Points compared in each clip, drawn at random, the same for prediction and truth; None takes all.
    max_points: int | None = 20_000
    icp_threshold: float | None = 0.1  # metres, of the ICP before the point metrics; None leaves it out
    seed: int = 0  # of the drawn points
    figures: int = 1  # clips of each length that are drawn, for the first method

    def __post_init__(self) -> None:
        if self.image_size is not None:
            check_size(self.image_size, "ClipSettings.image_size")
        lengths = self.clip_lengths
        if not lengths or min(lengths) < 2 or len(set(lengths)) < len(lengths):
            raise InputError(
                f"ClipSettings.clip_lengths must be different numbers of 2 or more frames, one at least, got {lengths}"
            )
        require_counts(self, "stride", "clips_per_sequence", "sets", "max_sequences", "max_points")
        require_counts(self, "seed", "figures", least=0)
        require_within(self, "(0, inf)", "icp_threshold")


def clip_protocols(dataset: str, split: str, settings: ClipSettings, image_size: tuple[int, int]) -> list[Protocol]:
    """One benchmark for each clip length of the settings, on images of `image_size` (H, W)."""
    spread = f"± is the standard deviation of the means of {settings.sets} sets, into which sequences are dealt round."
    return [
        Protocol(
            name=f"{dataset}-clips-{length}",
            title=f"clips of {length} frames",
            dataset=dataset,
            splits=(split,),
            frames=Clips(length, settings.stride, settings.clips_per_sequence),
            images=Fit(image_size),
            depth=DepthMeasure(),
            points=PointsMeasure(None, settings.max_points, settings.icp_threshold, settings.seed),
            poses=True,
            trajectory=True,
            sets=settings.sets,
            decisions=(spread,) if settings.sets > 1 else (),
        )
        for length in settings.clip_lengths
    ]
