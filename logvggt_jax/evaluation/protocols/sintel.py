"""Video depth on Sintel: all 23 training sequences, whole (20 to 50 frames), pass `final`."""

from logvggt_jax.evaluation.protocols.frame_selection import Leading
from logvggt_jax.evaluation.protocols.images import WholePicture
from logvggt_jax.evaluation.protocols.protocol import DepthMeasure, Protocol, ProtocolSettings

_FAR = 70.0  # metres


def video_depth(settings: ProtocolSettings) -> Protocol:
    """Abs Rel and delta 1.25 after one scale a sequence."""
    return Protocol(
        name="sintel-depth",
        title="Sintel (50 frames)",
        dataset="sintel",
        splits=("all",),
        frames=Leading(None),
        images=WholePicture(settings.longer_edge),
        depth=DepthMeasure(max_depth=_FAR, clip=_FAR),
        expected=23,
        decisions=(
            "Whole sequences of all 23 training sequences; the paper's 50 frames are the usual length, not a sampling.",
            "Alignment: one scale a sequence (the paper names none; its peers report this one). Valid: true depth "
            "below 70 m; aligned predictions are cut at 70 m. Predictions are resized bicubically to the truth.",
        ),
    )
