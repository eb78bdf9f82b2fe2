"""Video depth on Bonn RGB-D Dynamic: five sequences, 110 frames from the 30th; 200 and 500 in the appendix."""

from logvggt_jax.evaluation.protocols.frame_selection import Leading
from logvggt_jax.evaluation.protocols.images import WholePicture
from logvggt_jax.evaluation.protocols.protocol import DepthMeasure, Protocol, ProtocolSettings


def video_depth(settings: ProtocolSettings, num_frames: int) -> Protocol:
    """Abs Rel and delta 1.25 after one scale a sequence."""
    return Protocol(
        name=f"bonn-depth-{num_frames}",
        title=f"Bonn ({num_frames} frames)",
        dataset="bonn",
        splits=("all",),
        frames=Leading(num_frames, start=30),
        images=WholePicture(settings.longer_edge),
        depth=DepthMeasure(max_depth=70.0),
        sequences=r"rgbd_bonn_(balloon2|crowd2|crowd3|person_tracking2|synchronous)(/\w+)?",
        expected=5,
        decisions=(
            f"Frames 30 to {29 + num_frames} of the pictures that have depth and pose near them in time (published "
            "code pairs by position in the lists). The appendix says random frames; consecutive ones, as its peers.",
            "Alignment: one scale a sequence (the paper names none). Valid: true depth below 70 m. Predictions are "
            "resized bicubically to the truth.",
        ),
    )
