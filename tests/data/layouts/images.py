"""Pictures of a video and nothing else."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from room_views import RoomView, write_image

from layouts.layout import VIEWS, Layout
from logvggt_jax.data.readers.images import Images

NAME = "walk"
NAMES = ("view8.png", "view9.png", "view10.png", "view11.png")


def write(root: Path, views: Sequence[RoomView]) -> None:
    for name, each in zip(NAMES, views, strict=True):
        write_image(root / NAME / name, each.picture)


LAYOUT = Layout(
    Images,
    NAME,
    write,
    names=NAMES,
    image=f"{NAME}/view9.png",
    depth=f"{NAME}/view9.png",
    views=tuple(replace(each, depth=np.zeros_like(each.depth)) for each in VIEWS),
    poses="none",
)
