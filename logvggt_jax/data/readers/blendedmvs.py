"""BlendedMVS, BlendedMVS+ and BlendedMVS++, together BlendedMVG (Yao et al., CVPR 2020): photographs of 502 scenes
blended with renderings of their meshes.

Layout, as the set's README and MVSNet's describe it: `<root>/<PID>/blended_images/NNNNNNNN.jpg`,
`cams/NNNNNNNN_cam.txt`, `cams/pair.txt`, `rendered_depth_maps/NNNNNNNN.pfm`, where PID is 24 hexadecimal digits; the
three sets are unpacked into one root. `NNNNNNNN_masked.jpg` are ignored. The lists `BlendedMVG_training.txt` and
`validation_list.txt` of the set's repository lie in the root or in `<root>/project_lists`.

Extrinsics are world-to-camera with OpenCV axes, depth is z, both in units of the scene. The release does not say where
a pixel's centre is; the principal point is taken as it is. Depth is 0 where the mesh has a hole; whole frames may be
empty.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import TRAINING, About
from logvggt_jax.data.formats.calibration import numbers, world_to_camera
from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.data.formats.numbered_files import numbered_frames
from logvggt_jax.data.formats.pfm import read_pfm
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.formats.split_lists import sequences_present
from logvggt_jax.data.readers.folder_dataset import Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.errors import InputError

_SCENE = re.compile(r"[0-9a-f]{24}")
_LIST_FILES = {"train": "BlendedMVG_training.txt", "val": "validation_list.txt"}


class BlendedMVS(FolderDataset):
    """Reader of BlendedMVS, + and ++; sequences are named by their PID, such as `5bfe5ae0fe0ea555e6a969ca`.

    The frames of a scene are photographs in no temporal order; they keep the order of their numbers, and
    `covisibility` says which of them see the same. The splits `train` and `val` follow the official lists; scenes that
    these list and that are not in the root are left out, since the set comes in three parts.
    """

    name = "blendedmvs"
    title = "BlendedMVS"
    expects = "<24 hexadecimal digits>/blended_images (unpack the three sets' zip files into one folder)"
    metric = False
    splits = ("train", "val", "all")
    about = About(
        source="release files of the repository YoYo000/BlendedMVS: BlendedMVS, BlendedMVS+ and BlendedMVS++; for "
        "splits BlendedMVG_training.txt and validation_list.txt of its folder project_lists",
        licence="CC BY 4.0",
        size="27.5 + 81.5 + 80 GB at 768 x 576; 502 scenes, more than 110,000 pictures",
        roles=(TRAINING,),
    )

    def covisibility(self, sequence: str) -> dict[int, list[tuple[int, float]]]:
        """For every frame that has some, its neighbours (frame index, score), the best first.

        The scores are those of `cams/pair.txt`: larger where two photographs share more of the scene's points seen
        under a good angle; they have no unit. At most ten neighbours a frame, and not always both ways. Photographs
        that do not count as frames are left out. Raises MissingFiles without that file, InputError where it is damaged.
        """
        index = {int(name): i for i, name in enumerate(self.frame_names(sequence))}
        path = self._places[sequence] / "cams" / "pair.txt"
        neighbours: dict[int, list[tuple[int, float]]] = {}
        for image, pairs in _pairs(SourceFiles().text(path, "the scene's image pairs; unpack it again"), path):
            known = [(index[other], score) for other, score in pairs if other in index]
            if image in index and known:
                neighbours[index[image]] = sorted(known, key=lambda pair: -pair[1])
        return neighbours

    def neighbours(self, sequence: str, index: int) -> list[int]:
        """The neighbours of `covisibility`, the best first: numbers next to each other need not see the same."""
        return [other for other, _ in self.covisibility(sequence).get(index, [])]

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        scenes = files.folders(self.root, self.expects, _SCENE)
        if self.split == "all":
            return scenes
        path = self.root / _LIST_FILES[self.split]
        if not files.exists(path):
            path = self.root / "project_lists" / path.name
        text = files.text(path, "the list file of the set's repository, here or in the root; or choose split='all'")
        listed = text.split()
        for name in listed:
            if not _SCENE.fullmatch(name):
                raise InputError(f"{path}: expected lines of 24 hexadecimal digits, got {name!r}: restore the file")
        return {name: scenes[name] for name in sequences_present(listed, scenes, path, files)}

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        kinds = (("blended_images", "{:08d}.jpg"), ("rendered_depth_maps", "{:08d}.pfm"), ("cams", "{:08d}_cam.txt"))
        paths = numbered_frames(files, *((folder / place, template) for place, template in kinds))
        for image, depth, camera in paths.values():
            intrinsics, stored = _camera(files.text(camera, "the frame's camera"), camera)
            extrinsics = world_to_camera(stored, camera, stored="world_to_camera")
            yield frame(image, depth, intrinsics, extrinsics, calibration=camera)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return read_rgb(record.image), read_pfm(record.depth), record.intrinsics


def _camera(text: str, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics [3, 3] and stored extrinsics [4, 4] of a camera file.

    The two to four numbers of the depth range at its end are not needed, and wrong in some files.
    """
    words = text.split()
    if len(words) not in (29, 30, 31) or words[0] != "extrinsic" or words[17] != "intrinsic":
        raise InputError(
            f"{path}: expected 'extrinsic', 16 numbers, 'intrinsic', 9 numbers and 2 to 4 for the depth range, "
            f"got {len(words)} words: fetch the file again"
        )
    values = numbers(" ".join(words[1:17] + words[18:27]), path, count=25)
    return values[16:].reshape(3, 3), values[:16].reshape(4, 4)


def _pairs(text: str, path: Path) -> list[tuple[int, list[tuple[int, float]]]]:
    """Image numbers with their neighbours' numbers and scores."""
    values = numbers(text, path).tolist()
    position, pairs = 1, []
    try:
        for _ in range(int(values[0])):
            image, count = int(values[position]), int(values[position + 1])
            end = position + 2 + 2 * count
            scores = values[position + 2 : end]
            pairs.append((image, list(zip(map(int, scores[::2]), scores[1::2], strict=True))))
            position = end
        complete = position == len(values)
    except (IndexError, ValueError, OverflowError):
        complete = False
    if not complete:
        raise InputError(
            f"{path}: expected the number of images, then for each its number, how many neighbours, and their numbers "
            "and scores: fetch the file again"
        )
    return pairs
