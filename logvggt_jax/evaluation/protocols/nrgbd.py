"""3D reconstruction on Neural RGB-D: every synthetic scene, 200, 500 and 1,000 frames at a fixed stride."""

import dataclasses

from logvggt_jax.evaluation.protocols.frame_selection import Leading, Spread
from logvggt_jax.evaluation.protocols.images import PrincipalPointCrop
from logvggt_jax.evaluation.protocols.protocol import Protocol, ProtocolSettings

_SCENES = 9
_DEPTH = "True depth is the noise-free folder `depth`; frames whose pose is `nan` are left out, not taken as identity."


def reconstruction(settings: ProtocolSettings, num_frames: int) -> Protocol:
    """Acc, Comp, NC and Chamfer of `num_frames` frames; poses and trajectory beside them."""
    return Protocol(
        name=f"nrgbd-reconstruction-{num_frames}",
        title=f"NRGBD, {num_frames} frames",
        dataset="nrgbd",
        splits=("all",),
        frames=Spread(num_frames),
        images=PrincipalPointCrop(settings.longer_edge),
        points=settings.points,
        poses=True,
        trajectory=True,
        expected=_SCENES,
        decisions=(
            f"Frames: stride max(1, n // {num_frames}) of a scene of n frames, then the first {num_frames}; the "
            "paper says a fixed stride. Shorter scenes give all they have.",
            *settings.points_decisions,
            _DEPTH,
        ),
    )


def qualitative(settings: ProtocolSettings) -> Protocol:
    """The setting of the paper's figures: the first 100 frames."""
    return dataclasses.replace(
        reconstruction(settings, 500),
        name="nrgbd-figures",
        title="NRGBD, first 100 frames",
        frames=Leading(100),
        decisions=(*settings.points_decisions, _DEPTH),
    )
