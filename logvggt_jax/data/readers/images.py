"""Pictures of videos, nothing else: what a teacher can label.

Layout: the root is a folder of pictures, or holds folders of pictures; subfolders of those are not looked into. Frames
are in the natural order of their names (`img2` before `img10`), which is taken for their order in time. HEIC and AVIF
pictures are not read and do not count.
"""

import contextlib
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
from logvggt_jax.errors import DiskError

_NOT_READ = frozenset({".avif", ".heic", ".heif", ".hif"})


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
        def is_recording(folder: Path) -> bool:
            names = _pictures(folder, files)
            # Of those that are not read a few beside folders of pictures hide none of these.
            return any(is_picture(Path(name)) for name in names) or (
                bool(names) and (folder != self.root or not self._hidden_recordings(files))
            )

        found = find_recordings(self.root, files, self.expects, is_recording)
        if self.root in found.values() and (hidden := self._hidden_recordings(files)):
            files.remark(
                f"{self.root} is a sequence itself, of {_pictures(self.root, files)[0]} and others: folders of "
                f"pictures in it are not looked into ({', '.join(hidden[:3])}{' …' if len(hidden) > 3 else ''})"
            )
        return found

    def _hidden_recordings(self, files: SourceFiles) -> list[str]:
        """Folders of pictures in the root, which are not looked into where it is a recording itself."""
        hidden = []
        for name, folder in files.folders(self.root, "folders of pictures").items():
            with contextlib.suppress(DiskError):  # nobody asked for it
                if not name.startswith(".") and _pictures(folder, files):
                    hidden.append(name)
        return hidden

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        names = _pictures(folder, files)
        if not names:
            raise MissingFiles(f"{folder}: no pictures; expected {self.expects}")
        nominal = pinhole(1.0, 1.0, 0.0, 0.0)
        stems = [Path(name).stem for name in names]
        read = {stem for stem, name in zip(stems, names, strict=True) if is_picture(Path(name))}
        for place in natural_order(stems):
            if not is_picture(Path(names[place])):
                if stems[place] not in read:  # else it was converted
                    yield Dropped("HEIC or AVIF: convert it to JPEG")
                continue
            path = folder / names[place]
            yield frame(path, path, nominal, NO_POSES, name=names[place])

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        height, width = image.shape[:2]
        longer = float(max(height, width))
        intrinsics = pinhole(longer, longer, width / 2 - 0.5, height / 2 - 0.5)
        return image, np.zeros((height, width), np.float32), intrinsics


def _pictures(folder: Path, files: SourceFiles) -> list[str]:
    """Names of a folder's pictures, of those that are not read as well."""
    names = files.names(folder, "pictures")
    unread = {name for name in names if Path(name).suffix.lower() in _NOT_READ and not name.startswith(".")}
    return [name for name in names if name in unread or is_picture(Path(name))]
