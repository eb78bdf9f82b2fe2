"""Sources that nothing can be learned from are refused before anything is compiled."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from layouts.colmap import NAMES, write_depth_map, write_pictures, write_text_model
from layouts.layout import VIEWS

from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames
from logvggt_jax.training.config import SourceConfig, TrainConfig
from logvggt_jax.training.feeding.truth import check_depth
from logvggt_jax.training.teaching.run_data import open_data

FRAMES = 12


class Recording:
    """One sequence of which only some frames have depth or poses, and some cannot be read."""

    sequences = ("walk",)

    def __init__(self, *, depth: Sequence[int] = (), poses: Sequence[int] = (), broken: Sequence[int] = ()) -> None:
        self._depth, self._poses, self._broken = depth, poses, broken
        self.reads = 0

    def num_frames(self, sequence: str) -> int:
        return FRAMES

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        (index,) = indices
        if index in self._broken:
            raise OSError("input/output error")
        self.reads += 1
        return Frames(
            images=np.zeros((1, 4, 6, 3), np.uint8),
            depth=np.full((1, 4, 6), float(index in self._depth), np.float32),
            intrinsics=np.eye(3, dtype=np.float32)[None],
            extrinsics=np.full((1, 4, 4), 1.0 if index in self._poses else np.nan, np.float32),
            metric=True,
        )


def with_source(config: TrainConfig, source: SourceConfig) -> TrainConfig:
    return dataclasses.replace(config, data=dataclasses.replace(config.data, sources=(source,)))


def test_pictures_alone_are_refused_where_nobody_labels_them(tmp_path: Path, run_config: TrainConfig) -> None:
    config = with_source(run_config, SourceConfig("images", str(tmp_path), "all"))
    with pytest.raises(InputError, match=r"images \(.*\): .* no poses and no depth, .*configs/distill\.py"):
        open_data(config)


def test_pictures_with_cameras_alone_are_refused_until_they_have_depth(tmp_path: Path, run_config: TrainConfig) -> None:
    write_pictures(tmp_path, VIEWS)
    write_text_model(tmp_path / "sparse", VIEWS)
    config = with_source(run_config, SourceConfig("colmap", str(tmp_path), "all"))
    with pytest.raises(InputError, match=r"colmap \(.*\): none of the 4 frames that were looked at has depth, "):
        open_data(config)
    for name, view in zip(NAMES, VIEWS, strict=True):
        write_depth_map(tmp_path, name, view.depth)
    assert list(open_data(config)[0]) == ["colmap"]


@pytest.mark.parametrize(
    ("lacking", "recording"),
    [
        ("depth", Recording(poses=range(FRAMES))),
        ("poses", Recording(depth=range(FRAMES))),
        ("depth and poses", Recording()),
    ],
)
def test_a_source_without_depth_or_poses_is_named_with_what_it_needs(
    lacking: str, recording: Recording, run_config: TrainConfig
) -> None:
    config = with_source(run_config, SourceConfig("tum_recording", "mine", "all"))
    message = rf"tum_recording \(mine\): none of the 12 frames .* has {lacking}, .* expected rgb, depth.*distill\.py"
    with pytest.raises(InputError, match=message):
        check_depth(config, {"tum_recording": recording})  # type: ignore[dict-item]


def test_one_frame_with_depth_and_pose_is_enough_and_the_last_that_is_read(run_config: TrainConfig) -> None:
    config = with_source(run_config, SourceConfig("tum_recording", "mine", "all"))
    for recording, reads in (
        (Recording(depth=(0,), poses=(0,)), 1),
        (Recording(depth=(11,), poses=(4,)), FRAMES),
        # What is broken is for those to count who read clips.
        (Recording(broken=range(FRAMES)), 0),
    ):
        check_depth(config, {"tum_recording": recording})  # type: ignore[dict-item]
        assert recording.reads == reads
