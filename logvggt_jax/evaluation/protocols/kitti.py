"""Video depth on KITTI: the 13 validation drives, their first 110 annotated frames; 200 and 500 in the appendix."""

from logvggt_jax.evaluation.protocols.frame_selection import Leading
from logvggt_jax.evaluation.protocols.images import WholePicture
from logvggt_jax.evaluation.protocols.protocol import DepthMeasure, Protocol, ProtocolSettings


def video_depth(settings: ProtocolSettings, num_frames: int) -> Protocol:
    """Abs Rel and delta 1.25 after one scale a sequence."""
    return Protocol(
        name=f"kitti-depth-{num_frames}",
        title=f"KITTI ({num_frames} frames)",
        dataset="kitti",
        splits=("val",),
        frames=Leading(num_frames),
        images=WholePicture(settings.longer_edge),
        depth=DepthMeasure(),
        expected=13,
        decisions=(
            "Real KITTI: the paper's text says Virtual KITTI, its tables KITTI, and their baselines are those of the "
            "real one.",
            f"The first {num_frames} annotated frames of each drive; several drives are shorter, so that the settings "
            "overlap.",
            "Alignment: one scale a sequence (the paper names none). Valid: every LiDAR return, no crop, no bound. "
            "Predictions are resized bicubically to the truth.",
        ),
    )
