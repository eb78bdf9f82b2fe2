"""Procedural rooms: the benchmark that everyone has; exact depth, poses and points of rooms that are only a seed."""

from logvggt_jax.evaluation.protocols.frame_selection import Leading
from logvggt_jax.evaluation.protocols.images import PrincipalPointCrop
from logvggt_jax.evaluation.protocols.protocol import DepthMeasure, Protocol, ProtocolSettings


def everything(settings: ProtocolSettings, num_frames: int) -> Protocol:
    """Depth, poses, trajectory and points of the first `num_frames` frames of each test room."""
    return Protocol(
        name=f"rooms-{num_frames}",
        title=f"Procedural rooms, {num_frames} frames",
        dataset="rooms",
        splits=("test",),
        frames=Leading(num_frames),
        images=PrincipalPointCrop(settings.longer_edge),
        depth=DepthMeasure(),
        points=settings.points,
        poses=True,
        trajectory=True,
        decisions=settings.points_decisions,
    )
