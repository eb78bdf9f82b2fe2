"""Normalisation of clips against the original's values, and its behaviour on incomplete ground truth."""

from pathlib import Path

import jax
import numpy as np
import pytest

from logvggt_jax import geometry
from logvggt_jax.training.losses.normalization import Targets, normalize_clips

NORMALIZE, unproject = jax.jit(normalize_clips), jax.jit(geometry.unproject)


def _normalize(clips: dict[str, np.ndarray], **changes: np.ndarray) -> Targets:
    clips = {**clips, **changes}
    return NORMALIZE(clips["depth"], clips["intrinsics"], clips["extrinsics"], frame_mask=clips.get("frame_mask"))


def test_agrees_with_the_released_trainer(golden_dir: Path) -> None:
    golden = np.load(golden_dir / "vggt_losses.npz")
    targets = NORMALIZE(golden["depths"], golden["intrinsics"], golden["extrinsics"])
    valid = golden["point_masks"]
    np.testing.assert_array_equal(targets.depth_valid, valid)
    np.testing.assert_allclose(targets.extrinsics[..., :3, :], golden["norm_extrinsics"], atol=2e-6)
    np.testing.assert_allclose(np.asarray(targets.depth)[valid], golden["norm_depths"][valid], rtol=2e-6)
    np.testing.assert_allclose(targets.pose_encoding, golden["gt_pose_enc"], atol=2e-6)
    points = unproject(targets.depth, golden["intrinsics"], targets.extrinsics)
    np.testing.assert_allclose(np.asarray(points)[valid], golden["norm_world_points"][valid], atol=1e-5)


def test_first_camera_is_the_origin_and_points_lie_one_away_on_average(clips: dict[str, np.ndarray]) -> None:
    targets = _normalize(clips)
    np.testing.assert_allclose(targets.extrinsics[:, 0], np.tile(np.eye(4), (8, 1, 1)), atol=1e-6)
    points = np.asarray(unproject(targets.depth, clips["intrinsics"], targets.extrinsics))
    for clip, valid in zip(points, np.asarray(targets.depth_valid), strict=True):
        assert np.linalg.norm(clip[valid], axis=-1).mean() == pytest.approx(1.0, abs=1e-3)


def test_unit_and_world_frame_of_the_ground_truth_do_not_matter(clips: dict[str, np.ndarray]) -> None:
    moved = clips["extrinsics"] @ clips["extrinsics"][3, 2]
    moved[..., :3, 3] *= 7.0
    found = _normalize(clips, extrinsics=moved, depth=7.0 * clips["depth"])
    expected = _normalize(clips)
    np.testing.assert_allclose(found.depth, expected.depth, rtol=2e-5)
    np.testing.assert_allclose(found.pose_encoding, expected.pose_encoding, atol=2e-5)


def test_padding_changes_nothing(clips: dict[str, np.ndarray]) -> None:
    padded = ~clips["frame_mask"]
    depth, extrinsics = clips["depth"].copy(), clips["extrinsics"].copy()
    depth[padded], extrinsics[padded] = np.inf, np.nan
    found, expected = _normalize(clips, depth=depth, extrinsics=extrinsics), _normalize(clips)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert not np.asarray(found.depth_valid)[padded].any()


def test_frames_without_a_camera_are_absent_and_everything_stays_finite(clips: dict[str, np.ndarray]) -> None:
    extrinsics, depth = clips["extrinsics"].copy(), clips["depth"].copy()
    extrinsics[0, 2], extrinsics[3, 0], depth[5] = np.nan, np.nan, 0.0
    targets = _normalize(clips, extrinsics=extrinsics, depth=depth)
    valid = np.asarray(targets.frame_valid)
    assert not valid[0, 2], "no camera"
    assert valid[0, [0, 1, 3, 4]].all()
    assert not valid[3].any(), "no first camera"
    assert not valid[5].any(), "no scale"
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(targets))
