"""Pictures of videos, nothing else: what a teacher can label.

Layout: the root is a folder of pictures, or holds folders of pictures; subfolders of those are not looked into. Frames
are in the natural order of their names (`img2` before `img10`), which is taken for their order in time.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import TRAINING, About
from logvggt_jax.data.errors import MissingFiles
from logvggt_jax.data.formats.calibration import pinhole
from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.data.formats.ordering import natural_order
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import NO_POSES, Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.data.readers.own_recordings import find_recordings, is_picture


class Images(FolderDataset):
    """Reader of pictures without cameras or depth; sequences are named as their folders.

    Depth is 0 throughout, no pixel valid; extrinsics are NaN. Intrinsics are a stand-in that puts the principal point
    into the picture's centre, with a focal length of the longer edge: pictures are cropped around the centre.
    """

    name = "images"
    title = "pictures of videos"
    expects = "pictures (png, jpg, …), or folders of pictures; `ffmpeg -i walk.mp4 walk/%06d.jpg` makes them of a video"
    metric = False
    splits = ("all",)
    own = True
    truth = False
    about = About(source="film it", licence="your own", size="your own", roles=(TRAINING,))

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        return find_recordings(self.root, files, self.expects, lambda folder: _pictures(folder, files))

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        names = _pictures(folder, files)
        if not names:
            raise MissingFiles(f"{folder}: no pictures; expected {self.expects}")
        nominal = pinhole(1.0, 1.0, 0.0, 0.0)
        for place in natural_order(names):
            path = folder / names[place]
            yield frame(path, path, nominal, NO_POSES, name=names[place])

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        height, width = image.shape[:2]
        longer = float(max(height, width))
        intrinsics = pinhole(longer, longer, width / 2 - 0.5, height / 2 - 0.5)
        return image, np.zeros((height, width), np.float32), intrinsics


def _pictures(folder: Path, files: SourceFiles) -> list[str]:
    return [name for name in files.names(folder, "pictures") if is_picture(Path(name))]
