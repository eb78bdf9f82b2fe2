"""What each data set is, where it comes from and under which licence, as far as its documents say.

Readers know their layout; this file holds what only people need. "Inferred" and "unknown" are meant: nobody read it
in the set's own documents.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

from logvggt_jax.data.registry import READERS

UNPACKING = "Archives are never unpacked by this package: unpack them with your own tools, as each entry says."
_TRAINING, _EVALUATION = "training", "evaluation"


@dataclass(frozen=True)
class CatalogueEntry:
    """One data set.

    Attributes:
      name: as `open_dataset` takes it.
      title: as its owners write it.
      roles: `training`, `evaluation` or both, in the paper.
      folder: what the root folder must hold.
      obtain: how one gets it.
      licence: its terms, or `unknown`.
      size: bytes and counts, as far as known.
      metric: whether lengths are metres.
      splits: that its reader has.
      extra: extra of this package that its files need; None = none.
    """

    name: str
    title: str
    roles: tuple[str, ...]
    folder: str
    obtain: str
    licence: str
    size: str
    metric: bool
    splits: tuple[str, ...]
    extra: str | None = None

    def text(self, width: int = 100) -> str:
        """The entry as lines of up to `width` characters."""
        scale = "metres" if self.metric else "not metric, each sequence has a scale of its own"
        fields = {
            "for": f"{' and '.join(self.roles)}; splits {', '.join(self.splits)}; {scale}",
            "folder": self.folder,
            "obtain": self.obtain,
            "licence": self.licence,
            "size": self.size,
        }
        if self.extra:
            fields["install"] = f'pip install "logvggt-jax[{self.extra}]"'
        lines = [f"{self.name}: {self.title}"]
        for key, value in fields.items():
            lines += textwrap.wrap(
                value, width, initial_indent=f"  {key:<9}", subsequent_indent=" " * 11, break_on_hyphens=False
            )
        return "\n".join(lines)


def catalogue() -> list[CatalogueEntry]:
    """Every data set that `open_dataset` knows, in the order of `DATASETS`."""
    entries = [
        CatalogueEntry(
            name=name,
            title=reader.title,
            folder=reader.expects,
            metric=reader.metric,
            splits=reader.splits,
            roles=_FACTS[name].roles,
            obtain=_FACTS[name].obtain,
            licence=_FACTS[name].licence,
            size=_FACTS[name].size,
            extra=_FACTS[name].extra,
        )
        for name, reader in READERS.items()
    ]
    return [*entries, _ROOMS]


@dataclass(frozen=True)
class _Facts:
    obtain: str
    licence: str
    size: str
    roles: tuple[str, ...]
    extra: str | None = None


_SEE_SITE = "not read for this list: see the set's site"

_FACTS = {
    "co3dv2": _Facts(
        obtain="the project's download page or script (repository facebookresearch/co3d)",
        licence="CC BY-NC 4.0 for the code base; the same for the data (inferred)",
        size="5.5 TB of zip files of 20 GB, 51 categories; the single-sequence subset has 8.9 GB",
        roles=(_TRAINING, _EVALUATION),
    ),
    "blendedmvs": _Facts(
        obtain="release files of the repository YoYo000/BlendedMVS: BlendedMVS, BlendedMVS+ and BlendedMVS++; for "
        "splits BlendedMVG_training.txt and validation_list.txt of its folder project_lists",
        licence="CC BY 4.0",
        size="27.5 + 81.5 + 80 GB at 768 x 576; 502 scenes, more than 110,000 pictures",
        roles=(_TRAINING,),
    ),
    "arkitscenes": _Facts(
        obtain="download script of the repository apple/ARKitScenes, raw data",
        licence="Apple's own: personal, non-commercial; a second clause covers commercial use by companies with fewer "
        "than 700 million monthly users",
        size="5,071 videos (4,520 Training, 551 Validation); bytes of the raw form unknown (the 3DOD subset has "
        "623.4 GB)",
        roles=(_TRAINING,),
    ),
    "wildrgbd": _Facts(
        obtain="zip files by category (repository wildrgbd/wildrgbd)",
        licence="unknown: not stated in the repository",
        size="3.37 TB of zip files, about 4 TB unpacked; 46 categories",
        roles=(_TRAINING,),
    ),
    "scannet": _Facts(
        obtain="terms-of-use form by e-mail (repository ScanNet/ScanNet); export each .sens with its SensReader; for "
        "splits the lists scannetv2_{train,val,test}.txt in the root",
        licence="ScanNet's terms of use, which the form states",
        size="1,613 scenes in the lists (1,201 train, 312 val, 100 test); bytes unknown",
        roles=(_TRAINING, _EVALUATION),
    ),
    "mvs_synth": _Facts(
        obtain="DeepMVS project page (repository phuang17/DeepMVS); only GTAV_720 is read",
        licence="unknown",
        size="120 sequences of 100 frames; bytes unknown",
        roles=(_TRAINING,),
        extra="data",
    ),
    "pointodyssey": _Facts(
        obtain="project page (repository y-zheng18/point_odyssey), release v1.2; v1.0 is refused",
        licence="CC BY-NC-SA 4.0",
        size="159 videos (131 train, 15 val, 13 test); bytes unknown",
        roles=(_TRAINING,),
    ),
    "virtual_kitti": _Facts(
        obtain="its owners' page: the archives of pictures, depth and text ground truth of version 2.0.3",
        licence="CC BY-NC-SA 3.0",
        size="21,260 stereo pairs: 5 scenes in 10 variations, 2 cameras; bytes unknown",
        roles=(_TRAINING, _EVALUATION),
    ),
    "spring": _Facts(
        obtain="the benchmark's site or DaRUS (doi 10.18419/darus-3376): frame_left, disp1_left and cam_data",
        licence="CC BY 4.0 (inferred)",
        size="37 training sequences, 5,000 frames; the 10 test sequences have no depth; bytes unknown",
        roles=(_TRAINING,),
        extra="data",
    ),
    "hypersim": _Facts(
        obtain="download script of the repository apple/ml-hypersim, a zip file a scene (parts of scenes: "
        "contrib/99991); metadata_camera_parameters.csv from contrib/mikeroberts3000 and, for splits, "
        "metadata_images_split_scene_v1.csv from evermotion_dataset/analysis",
        licence="CC BY-SA 3.0",
        size="1.9 TB; 74,619 pictures of 457 scenes",
        roles=(_TRAINING,),
        extra="data",
    ),
    "replica": _Facts(
        obtain="the rendering that the download script of the repository cvg/nice-slam fetches; the official meshes "
        "hold no pictures",
        licence="Replica's research terms: non-commercial research or education",
        size="8 scenes of 2,000 frames each (inferred); bytes unknown",
        roles=(_TRAINING,),
    ),
    "seven_scenes": _Facts(
        obtain="the set's site: a zip file a scene, zip files of sequences within",
        licence=_SEE_SITE,
        size="7 scenes; bytes unknown",
        roles=(_EVALUATION,),
    ),
    "nrgbd": _Facts(
        obtain="repository dazinovic/neural-rgbd-surface-reconstruction",
        licence="CC BY or CC0, by scene",
        size="7.25 GB",
        roles=(_EVALUATION,),
    ),
    "sintel": _Facts(
        obtain="the set's site: the archive of pictures and that of depth and cameras",
        licence=_SEE_SITE,
        size="23 training sequences, of which published evaluations use 14; bytes unknown",
        roles=(_EVALUATION,),
    ),
    "bonn": _Facts(
        obtain="the set's site; published evaluations use balloon2, crowd2, crowd3, person_tracking2 and synchronous",
        licence=_SEE_SITE,
        size="unknown",
        roles=(_EVALUATION,),
    ),
    "kitti": _Facts(
        obtain="the set's site: data_depth_annotated.zip, and the raw recordings (synced and rectified) of its drives "
        "with the calibration of their dates",
        licence=_SEE_SITE,
        size="13 drives in val; bytes unknown",
        roles=(_EVALUATION,),
    ),
    "tum": _Facts(
        obtain="the set's site: an archive a sequence",
        licence=_SEE_SITE,
        size="unknown",
        roles=(_EVALUATION,),
    ),
}

_ROOMS = CatalogueEntry(
    name="rooms",
    title="procedural rooms",
    roles=(_TRAINING, _EVALUATION),
    folder="none: rooms are rendered when they are read",
    obtain="comes with this package",
    licence="Apache-2.0, this package's",
    size="1,500 rooms to train on, 32 to validate, 32 to test",
    metric=True,
    splits=("train", "val", "test", "all"),
)
