"""Common Objects in 3D, version 2 (Reizenstein et al., ICCV 2021): videos around objects of 51 categories.

Layout, as the set's README describes it: `<root>/<category>/frame_annotations.jgz` and `sequence_annotations.jgz`
(lists in JSON, gzip), `<root>/<category>/set_lists/set_lists_<subset>.json`, and
`<root>/<category>/<sequence>/{images,depths,masks,depth_masks}/`, whose files the annotations name relative to the
root. Frames are ordered by their annotated number, which need not be the one in the picture's name.

Cameras are PyTorch3D's (see `co3d_annotations`), with a pixel's centre at half integers. Depth is z in units of the
reconstruction, stored as the bits of 16-bit floats in 16-bit PNG files, times the frame's `scale_adjustment`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, TRAINING, About
from logvggt_jax.data.errors import EmptySplit, MissingFiles, UnequalSizes, missing_files
from logvggt_jax.data.formats.calibration import in_pixels, relative
from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.data.formats.json_values import expecting, read_json
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.formats.split_lists import sequences_present
from logvggt_jax.data.readers.co3d_annotations import FrameAnnotation, frame_annotations, quality_scores
from logvggt_jax.data.readers.folder_dataset import Dropped, FolderDataset, FrameRecord, frame

_FRAMES, _SEQUENCES = "frame_annotations.jgz", "sequence_annotations.jgz"
_MIN_QUALITY = 0.5


@dataclass(frozen=True)
class _Category:
    """Frames of a category by sequence, and the state of the files that say so."""

    folder: Path
    states: Mapping[str, list[int]]
    frames: Mapping[str, list[FrameAnnotation]]

    def is_current(self) -> bool:
        now = SourceFiles()
        for path in self.states:
            now.exists(Path(path))
        return now.states == self.states


class Co3Dv2(FolderDataset):
    """Reader of Co3Dv2; sequences are named `apple/110_13051_23361`.

    Sequences whose `viewpoint_quality_score` is 0.5 or less, or unknown, have unreliable cameras and are in no split;
    neither are sequences without a folder, since the set comes in parts of 20 GB. The splits hold the frames that the
    categories' set lists name:

    - `train`: "train" of the lists with `fewview_train` in their name.
    - `test`: "test" of `set_lists_fewview_dev.json`, on which poses are evaluated. (The challenge's own test
      sequences are published without ground truth.)
    - `val`: "val" of `set_lists_fewview_dev.json`, without sequences that the two others name.
    - `all`: every annotated frame; needs no lists.

    A category without the lists of a split has no sequences in it; the set's single-sequence subset has none at all.

    Depth is 0 where the file has 0, a negative or no finite number, and where the depth mask is 0. The object's mask
    is not applied. Frames without depth (`no depth`), and with a camera that is absent, not finite or absurdly far
    away (`no pose`), do not count. Pictures and depth may be resized copies: the intrinsics follow their size.
    """

    name = "co3dv2"
    title = "Co3Dv2"
    expects = f"<category>/{_FRAMES} (unpack the categories' zip files into one folder)"
    metric = False
    splits = ("train", "val", "test", "all")
    about = About(
        source="the project's download page or script (repository facebookresearch/co3d)",
        licence="CC BY-NC 4.0 for the code base; the same for the data (inferred)",
        size="5.5 TB of zip files of 20 GB, 51 categories; the single-sequence subset has 8.9 GB",
        roles=(TRAINING, EVALUATION),
    )

    def __init__(self, root: str | Path, split: str = "all") -> None:
        """As `FolderDataset`; a category's annotations are read when one of its sequences is first used."""
        # Annotations take many seconds to parse: the last category's serve all of its sequences.
        self._category: _Category | None = None
        super().__init__(root, split)

    @property
    def identity(self) -> dict[str, Any]:
        """As `FolderDataset`; the same sequence can have other frames in another split."""
        return {**super().identity, "split": self.split}

    def __getstate__(self) -> dict[str, Any]:
        """Worker processes are not sent a category's annotations."""
        return {**self.__dict__, "_category": None}

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        places: dict[str, Path] = {}
        lists_name_any = False
        categories = [
            self.root / name
            for name in files.names(self.root, self.expects)
            if files.exists(self.root / name / _FRAMES)
        ]
        for category in categories:
            scores = quality_scores(files, category / _SEQUENCES)
            good = {name for name, score in scores.items() if score > _MIN_QUALITY}
            chosen = {
                name for name in files.names(category, "sequences") if name in good and (category / name).is_dir()
            }
            listed = self._listed_frames(category, files)
            if listed is not None:
                lists_name_any |= bool(listed)
                chosen = set(
                    sequences_present({name for name, _ in listed} & good, chosen, category / "set_lists", files)
                )
            places |= {f"{category.name}/{name}": category / name for name in sorted(chosen)}
        if categories and not places and self.split != "all":
            error = EmptySplit if lists_name_any else MissingFiles
            raise error(
                f"{self.root}: the set lists of {len(categories)} categories name no sequence here for split "
                f"{self.split!r}; unpack the sequences and lists (the single-sequence subset has none) or choose "
                "split='all'"
            )
        if categories and not places:
            raise EmptySplit(
                f"{self.root}: no sequence that has a folder has a viewpoint_quality_score above {_MIN_QUALITY} in "
                f"{_SEQUENCES} of {len(categories)} categories ({categories[0] / _SEQUENCES}, for example): unpack the "
                "sequences or fetch the annotations again"
            )
        return places

    def _listed_frames(self, category: Path, files: SourceFiles) -> set[tuple[str, int]] | None:
        """Sequence and number of a category's frames in the split; None for all of them."""
        if self.split == "all":
            return None
        folder = category / "set_lists"
        names = files.names(folder, "the category's set lists; unpack its first zip file again or choose split='all'")
        train = [folder / name for name in names if "fewview_train" in name and name.endswith(".json")]
        dev = [folder / name for name in names if name == "set_lists_fewview_dev.json"]
        if self.split == "train":
            return _listed(files, train, "train")
        test = _listed(files, dev, "test")
        if self.split == "test":
            return test
        taken = {sequence for sequence, _ in _listed(files, train, "train") | test}
        return {frame for frame in _listed(files, dev, "val") if frame[0] not in taken}

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        source = folder.parent / _FRAMES
        present: dict[Path, set[str]] = {}
        absent: list[Path] = []
        for annotation in self._annotations(folder.parent, files).get(folder.name, []):
            extrinsics = annotation.extrinsics(f"{source}, {annotation.image}")
            if extrinsics is None:
                yield Dropped("no pose")
                continue
            if annotation.depth is None:
                yield Dropped("no depth")
                continue
            image, depth = self.root / annotation.image, self.root / annotation.depth
            mask = self.root / annotation.depth_mask if annotation.depth_mask else None
            for path in filter(None, (image, depth, mask)):
                if path.parent not in present:
                    present[path.parent] = set(files.names(path.parent, f"{path.name}, which {source} names"))
                if path.name not in present[path.parent]:
                    absent.append(path)
            intrinsics = relative(annotation.intrinsics(), annotation.size)
            others = {"companion": mask, "calibration": source, "depth_scale": annotation.depth_scale}
            yield frame(image, depth, intrinsics, extrinsics, **others)
        if absent:
            raise missing_files(dict.fromkeys(absent, f"but {source} names it; unpack the sequence again"))

    def _annotations(self, category: Path, files: SourceFiles) -> Mapping[str, list[FrameAnnotation]]:
        if self._category is None or self._category.folder != category or not self._category.is_current():
            self._category = None  # the last one's memory, before the next one is parsed
            own = SourceFiles()
            frames = frame_annotations(own, category / _FRAMES, self._listed_frames(category, own))
            self._category = _Category(category, own.states, frames)
        files.states.update(self._category.states)
        return self._category.frames

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        depth = read_depth(record.depth).view(np.float16).astype(np.float32) * np.float32(record.depth_scale)
        if record.companion is not None:
            mask = read_rgb(record.companion)[..., 0]
            if mask.shape != depth.shape:
                raise UnequalSizes(
                    f"{record.companion}: size {mask.shape} differs from {depth.shape} of {record.depth.name}: "
                    "fetch both again"
                )
            depth[mask == 0] = 0
        intrinsics = in_pixels(record.intrinsics, image.shape[:2], record.image, record.calibration)
        return image, depth, intrinsics


def _listed(files: SourceFiles, paths: list[Path], part: str) -> set[tuple[str, int]]:
    """Sequence and number of the frames that the lists have under `part`."""
    frames: set[tuple[str, int]] = set()
    for path in paths:
        content = read_json(files.text(path, "the set list"), path)
        with expecting(path, f"[sequence, frame number, picture] under {part!r}"):
            frames |= {(str(sequence), int(number)) for sequence, number, *_ in content[part]}
    return frames
