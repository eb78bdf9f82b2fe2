"""Pictures of a validation: both depths on one scale, errors where they are, the camera's way to scale."""

import numpy as np
import pytest

from logvggt_jax.colours import coloured, depth_picture
from logvggt_jax.frames import Frames
from logvggt_jax.training.validation.pictures import clip_picture, trajectory_picture

COLUMNS = ("input", "true", "predicted", "error", "confidence")
WIDTH, HEADER = 168, 18  # 42 pixels four times


@pytest.fixture(scope="module")
def clip() -> Frames:
    generator = np.random.default_rng(0)
    depth = generator.uniform(1, 4, (6, 28, 42)).astype(np.float32)
    depth[:, :7] = 0
    images = generator.integers(0, 256, (6, 28, 42, 3)).astype(np.uint8)
    return Frames(images, depth, np.zeros((6, 3, 3), np.float32), np.tile(np.eye(4, dtype=np.float32), (6, 1, 1)), True)


def _columns(picture: np.ndarray) -> dict[str, np.ndarray]:
    """The five pictures of the first frame, at their own size."""
    row = picture[HEADER : HEADER + 112 : 4]
    return {name: row[:, WIDTH * i : WIDTH * (i + 1) : 4] for i, name in enumerate(COLUMNS)}


def test_numbers_have_one_scale_from_dark_to_bright() -> None:
    shown = coloured(np.array([[np.nan, 0.0, 0.3, 0.6, 1.0, 7.0]]))[0].astype(int).sum(-1)
    assert shown[0] == 0 and (np.diff(shown[1:5]) > 0).all() and shown[5] == shown[4]


def test_a_perfect_prediction_in_another_unit_looks_like_the_truth_without_error(clip: Frames) -> None:
    picture = clip_picture(clip, 3 * np.where(clip.depth > 0, clip.depth, 2), np.ones_like(clip.depth))
    assert picture.dtype == np.uint8 and picture.shape == (HEADER + 4 * 112, 5 * WIDTH, 3), "four of six frames"
    shown = _columns(picture)
    np.testing.assert_array_equal(shown["input"], clip.images[0])
    known = clip.depth[0] > 0
    np.testing.assert_array_equal(shown["true"][known], shown["predicted"][known])
    assert (shown["true"][~known] == 0).all() and (shown["predicted"][~known] > 0).any(), "it is also seen elsewhere"
    np.testing.assert_array_equal(shown["error"][known], np.broadcast_to(coloured(np.zeros((1, 1)))[0], (21 * 42, 3)))
    near, far = np.percentile(clip.depth[clip.depth > 0], (2, 98))
    np.testing.assert_array_equal(shown["true"], depth_picture(clip.depth[0], near=near, far=far))


def test_errors_and_confidence_are_brighter_where_they_are_larger(clip: Frames) -> None:
    depth, confidence = clip.depth.copy(), np.ones_like(clip.depth)
    depth[:, 20:, :20] *= 1.4
    confidence[:, :, 30:] = 5.0
    shown = {name: tile.astype(int).sum(-1) for name, tile in _columns(clip_picture(clip, depth, confidence)).items()}
    assert shown["error"][20:, :20].min() > shown["error"][7:20, 20:].max()
    assert (shown["error"][:7] == 0).all()
    assert shown["confidence"][:, 30:].min() > shown["confidence"][:, :30].max()


def test_a_model_without_numbers_and_a_clip_without_depth_are_shown_too(clip: Frames) -> None:
    lost = np.full_like(clip.depth, np.nan)
    shown = _columns(clip_picture(clip, lost, lost))
    assert (shown["predicted"] == 0).all() and (shown["true"][7:] > 0).any()
    nothing = clip._replace(depth=np.zeros_like(clip.depth))
    assert (_columns(clip_picture(nothing, clip.depth + 1, 1 + clip.depth))["true"] == 0).all()
    poses = np.tile(np.eye(4), (6, 1, 1))
    assert not _is_orange(trajectory_picture(np.full((6, 3, 4), np.nan), poses)).any()


def _is_orange(picture: np.ndarray) -> np.ndarray:
    """Where the predicted way is drawn, without the legend below."""
    red, green, blue = np.moveaxis(picture[:300].astype(int), -1, 0)
    return (red - blue > 150) & (green < 200)


def test_a_way_is_drawn_to_scale_and_covers_the_truth_where_it_is_right() -> None:
    steps = np.linspace(0, 1, 9)
    true = np.tile(np.eye(4), (9, 1, 1))
    true[:, 0, 3], true[:, 2, 3] = -steps, -(steps**2)  # world-to-camera without rotation: centres are the negative
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], float)
    other = true.copy()  # the same cameras in another world and unit
    other[:, :3, :3], other[:, :3, 3] = turn, 5 * true[:, :3, 3]
    same = _is_orange(trajectory_picture(other, true))
    dark = (trajectory_picture(true[:1].repeat(9, 0), true)[:300] < 60).all(-1)
    assert same.sum() > 100
    wrong = true.copy()
    wrong[:, 2, 3] *= -1
    assert (_is_orange(trajectory_picture(wrong, true)) & same).sum() < 0.5 * same.sum()
    # It rises to the right: ahead is up.
    rows, columns = np.nonzero(same)
    assert np.corrcoef(rows, columns)[0, 1] < -0.9 and dark.any()
