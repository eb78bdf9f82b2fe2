"""3D reconstruction on 7-Scenes: every test sequence, 200, 500 and 1,000 frames at a fixed stride."""

import dataclasses

from logvggt_jax.evaluation.protocols.frame_selection import Leading, Spread
from logvggt_jax.evaluation.protocols.images import PrincipalPointCrop
from logvggt_jax.evaluation.protocols.protocol import Protocol, ProtocolSettings

_TEST_SEQUENCES = 18
_DEPTH = (
    "Depth is registered to the colour camera: `depth.proj.png` where present, else raw depth carried over by the "
    "reader, invalid pixels masked first. Poses are those of the data set (KinectFusion); they drift by about 1.5 "
    "degrees. Where a scene has structure-from-motion poses, errors against them stand in columns of their own."
)


def reconstruction(settings: ProtocolSettings, num_frames: int) -> Protocol:
    """Acc, Comp, NC and Chamfer of `num_frames` frames; poses and trajectory beside them."""
    return Protocol(
        name=f"seven_scenes-reconstruction-{num_frames}",
        title=f"7-Scenes, {num_frames} frames",
        dataset="seven_scenes",
        splits=("test", "all"),
        frames=Spread(num_frames),
        images=PrincipalPointCrop(settings.longer_edge),
        points=settings.points,
        poses=True,
        trajectory=True,
        expected=_TEST_SEQUENCES,
        decisions=(
            f"Frames: stride max(1, n // {num_frames}) of a sequence of n frames, then the first {num_frames}; the "
            "paper says a fixed stride. Shorter sequences (stairs has 500 frames) give all they have.",
            *settings.points_decisions,
            _DEPTH,
        ),
    )


def qualitative(settings: ProtocolSettings) -> Protocol:
    """The setting of the paper's figures: every second frame, about 500 a sequence."""
    return dataclasses.replace(
        reconstruction(settings, 500),
        name="seven_scenes-figures",
        title="7-Scenes, every second frame",
        frames=Leading(None, stride=2),
        decisions=(*settings.points_decisions, _DEPTH),
    )
