"""Camera poses on ScanNet's test scenes: 500 random frames a scene; ATE against the number of views."""

from logvggt_jax.data.feeding.holdouts import PUBLISHED
from logvggt_jax.evaluation.protocols.frame_selection import Leading, RandomFrames
from logvggt_jax.evaluation.protocols.images import WidthResize
from logvggt_jax.evaluation.protocols.protocol import Protocol, ProtocolSettings

# Also those in the prepared form, `scene0707_00/color_90`: a copy without split lists gives the scenes of training too.
_TEST_SCENES = PUBLISHED["scannet"].names
_SEQUENCES = rf"({'|'.join(_TEST_SCENES)})(/.*)?"
_TRAINED = "ScanNet is a training set as well; only official test scenes are evaluated."


def poses(settings: ProtocolSettings, num_frames: int) -> Protocol:
    """RRA, RTA and AUC at 30 degrees over all pairs of frames."""
    return Protocol(
        name=f"scannet-poses-{num_frames}",
        title=f"ScanNet, {num_frames} frames",
        dataset="scannet",
        splits=("test", "all"),
        frames=RandomFrames(num_frames, settings.seed),
        images=WidthResize(settings.longer_edge),
        poses=True,
        trajectory=True,
        sequences=_SEQUENCES,
        expected=len(_TEST_SCENES),
        decisions=(
            _TRAINED,
            f"{num_frames} frames drawn with seed {settings.seed}, fed in time order (the paper does not say); all "
            "pairs; plain mean over scenes.",
        ),
    )


def trajectory(settings: ProtocolSettings, num_frames: int) -> Protocol:
    """ATE of the first `num_frames` of every third frame."""
    return Protocol(
        name=f"scannet-ate-{num_frames}",
        title=f"ScanNet, first {num_frames} views",
        dataset="scannet",
        splits=("test", "all"),
        frames=Leading(num_frames, stride=3),
        images=WidthResize(settings.longer_edge),
        trajectory=True,
        sequences=_SEQUENCES,
        expected=len(_TEST_SCENES),
        decisions=(
            _TRAINED,
            "Every third frame from the first, as peers prepare the set; the paper's figure names no frames.",
        ),
    )
