"""The benchmarks of the paper, one file each, in the order of its tables."""

import fnmatch
from collections.abc import Sequence

from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.protocols import bonn, co3dv2, kitti, nrgbd, rooms, scannet, seven_scenes, sintel, tum
from logvggt_jax.evaluation.protocols.protocol import DepthMeasure, PointsMeasure, Protocol, ProtocolSettings

__all__ = [
    "ATE_VIEWS",
    "DepthMeasure",
    "PointsMeasure",
    "Protocol",
    "ProtocolSettings",
    "chosen_protocols",
    "paper_protocols",
]

# The paper's figure has no numbers on its axis in the source; this is the grid of a peer's figure of the same kind.
ATE_VIEWS = (50, 100, 150, 200, 300, 400, 500, 600, 700, 800, 900, 1000)


def paper_protocols(settings: ProtocolSettings) -> list[Protocol]:
    """Every benchmark: tables, ablations (10 and 200 frames), figures, ATE against views, procedural rooms."""
    return [
        *(seven_scenes.reconstruction(settings, count) for count in (10, 200, 500, 1000)),
        *(nrgbd.reconstruction(settings, count) for count in (10, 200, 500, 1000)),
        sintel.video_depth(settings),
        *(bonn.video_depth(settings, count) for count in (110, 200, 500)),
        *(kitti.video_depth(settings, count) for count in (110, 200, 500)),
        scannet.poses(settings, 500),
        tum.poses(settings, 500),
        *(co3dv2.poses(settings, count) for count in (10, 200, 500)),
        *(scannet.trajectory(settings, count) for count in ATE_VIEWS),
        *(tum.trajectory(settings, count) for count in ATE_VIEWS),
        seven_scenes.qualitative(settings),
        nrgbd.qualitative(settings),
        *(rooms.everything(settings, count) for count in (12, 96)),
    ]


def chosen_protocols(settings: ProtocolSettings, patterns: Sequence[str]) -> list[Protocol]:
    """Those benchmarks whose name matches one of the patterns (`seven_scenes-*`, `*-depth-110`), in their order.

    Raises InputError naming the benchmarks for a pattern that matches none.
    """
    protocols = paper_protocols(settings)
    names = [protocol.name for protocol in protocols]
    for pattern in patterns:
        if not fnmatch.filter(names, pattern):
            raise InputError(f"no benchmark is named {pattern!r}; there are {', '.join(names)}")
    return [protocol for protocol in protocols if any(fnmatch.fnmatch(protocol.name, p) for p in patterns)]
