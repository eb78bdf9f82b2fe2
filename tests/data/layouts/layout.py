"""What the contract test needs to know of a data set's files."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from room_views import RoomView, room_views

from logvggt_jax.data.readers.folder_dataset import FolderDataset

VIEWS = room_views(4)
Damage = Callable[[Path], object]
"""Does something to a copy in the folder it is given."""


def written(name: str, content: str | bytes) -> Damage:
    data = content.encode() if isinstance(content, str) else content
    return lambda root: (root / name).write_bytes(data)


def changed(name: str, change: Callable[[bytes], bytes]) -> Damage:
    return lambda root: (root / name).write_bytes(change((root / name).read_bytes()))


def relined(name: str, change: Callable[[list[str]], list[str]]) -> Damage:
    return lambda root: (root / name).write_text("\n".join(change((root / name).read_text().splitlines())))


def removed(*names: str) -> Damage:
    return lambda root: [(root / name).unlink() for name in names]


@dataclass(frozen=True)
class Layout:
    """How the frames `views` are written as a copy of one data set, and what its reader then hands out.

    Attributes:
      reader: its class.
      sequence: the name of the sequence that is written.
      write: writes `views` into a root folder, as they are: lost poses, no depth, depth of another size.
      names: of the frames, in order.
      image, depth: files of the second frame, relative to the root.
      needed: files and folders without which the sequence cannot be listed.
      tables: files of calibrations and poses.
      views: what is written.
      developed: the picture handed out for the one written.
      depth_error: metres.
      picture_error: mean, in levels.
      unit: lengths handed out for a metre.
      damages: what is done to a copy, each with what the error then says.
      poses: `matrix` where the files can hold any matrix, `rigid` where only rigid poses, `none`.
    """

    reader: type[FolderDataset]
    sequence: str
    write: Callable[[Path, Sequence[RoomView]], None]
    names: Sequence[str]
    image: str
    depth: str
    needed: Sequence[str] = ()
    tables: Sequence[str] = ()
    views: Sequence[RoomView] = tuple(VIEWS)
    developed: Callable = staticmethod(lambda picture: picture)
    depth_error: float = 1e-5
    picture_error: float = 0.0
    unit: float = 1.0
    damages: Sequence[tuple[str, Damage]] = ()
    poses: str = "matrix"
