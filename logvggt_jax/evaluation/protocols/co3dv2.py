"""Camera poses on Co3Dv2: test sequences of every category, 500 random frames; and VGGT's own 10 frames."""

from logvggt_jax.evaluation.protocols.frame_selection import RandomFrames
from logvggt_jax.evaluation.protocols.images import WidthResize
from logvggt_jax.evaluation.protocols.protocol import Protocol, ProtocolSettings


def poses(settings: ProtocolSettings, num_frames: int) -> Protocol:
    """RRA, RTA and AUC at 30 degrees; pairs pooled in a category, mean over categories."""
    return Protocol(
        name=f"co3dv2-poses-{num_frames}",
        title=f"CO3Dv2, {num_frames} frames",
        dataset="co3dv2",
        splits=("test", "all"),
        frames=RandomFrames(num_frames, settings.seed),
        images=WidthResize(settings.longer_edge),
        poses=True,
        pooled=True,
        decisions=(
            f"min({num_frames}, n) of a sequence's n frames (most have 100 to 200, so that 500 are all of them), "
            f"drawn with seed {settings.seed} for each sequence, fed in time order (the paper does not say).",
            "Sequences of the official test lists, or in a copy without them (split all) of all that is there, with "
            "viewpoint quality above 0.5. Published code leaves out ten of the 51 categories, and sequences of fewer "
            "than 50 frames; here all count. Co3Dv2 is a training set as well.",
        ),
    )
