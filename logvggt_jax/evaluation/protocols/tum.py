"""Camera poses on TUM-dynamics (eight freiburg3 sequences): 500 random frames; ATE against the number of views."""

from logvggt_jax.evaluation.protocols.frame_selection import Leading, RandomFrames
from logvggt_jax.evaluation.protocols.images import WidthResize
from logvggt_jax.evaluation.protocols.protocol import Protocol, ProtocolSettings

_SEQUENCES = r"rgbd_dataset_freiburg3_(sitting|walking)_(static|xyz|halfsphere|rpy)(/\w+)?"


def poses(settings: ProtocolSettings, num_frames: int) -> Protocol:
    """RRA, RTA and AUC at 30 degrees over all pairs of frames."""
    return Protocol(
        name=f"tum-poses-{num_frames}",
        title=f"TUM-D, {num_frames} frames",
        dataset="tum",
        splits=("all",),
        frames=RandomFrames(num_frames, settings.seed),
        images=WidthResize(settings.longer_edge),
        poses=True,
        trajectory=True,
        sequences=_SEQUENCES,
        expected=8,
        decisions=(
            f"{num_frames} frames drawn with seed {settings.seed}, fed in time order (the paper does not say); all "
            "pairs; plain mean over sequences. The two `static` sequences hardly move: most of their directions of "
            "translation are noise.",
        ),
    )


def trajectory(settings: ProtocolSettings, num_frames: int) -> Protocol:
    """ATE of the first `num_frames` frames."""
    return Protocol(
        name=f"tum-ate-{num_frames}",
        title=f"TUM-D, first {num_frames} views",
        dataset="tum",
        splits=("all",),
        frames=Leading(num_frames),
        images=WidthResize(settings.longer_edge),
        trajectory=True,
        sequences=_SEQUENCES,
        expected=8,
        decisions=("Consecutive frames from the first that has a pose; the paper's figure names no frames.",),
    )
