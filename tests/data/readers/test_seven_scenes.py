"""7-Scenes: raw depth is carried into the colour camera, lists, real frames agree with each other."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from absl import logging

from logvggt_jax.data import open_dataset
from logvggt_jax.data.checks.consistency import depth_consistency
from logvggt_jax.data.dataset import check_frames
from logvggt_jax.data.readers.seven_scenes import SevenScenes
from logvggt_jax.geometry import unproject

SHIFT = np.array([-0.025, 0.0, 0.0])
# A slanted wall n . x = d, in the world, in front of all cameras.
NORMAL, DISTANCE = np.array([0.3, -0.2, 1.0]), 2.4


def camera_to_world(index: int) -> np.ndarray:
    angle = 0.06 * index
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [0.1 * index, -0.02 * index, 0.05 * index]
    return pose


def wall_depth(pose: np.ndarray, focal: float, size: tuple[int, int]) -> np.ndarray:
    """z-depth of the wall for a camera-to-world `pose`, float64 metres."""
    v, u = np.indices(size)
    scale_y, scale_x = size[0] / 480, size[1] / 640
    rays = np.stack(
        [
            (u - (320.5 * scale_x - 0.5)) / (focal * scale_x),
            (v - (240.5 * scale_y - 0.5)) / (focal * scale_y),
            np.ones(size),
        ],
        -1,
    )
    return (DISTANCE - NORMAL @ pose[:3, 3]) / (rays @ (pose[:3, :3].T @ NORMAL))


def picture(index: int, size: tuple[int, int]) -> np.ndarray:
    return np.full((*size, 3), (10 * index, 100, 200), np.uint8)


def write_frame(folder: Path, index: int, *, suffix: str = "png", size=(480, 640), depth=None) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    stem = str(folder / f"frame-{index:06d}")
    if depth is None:
        depth = np.rint(wall_depth(camera_to_world(index), 585.0, size) * 1000).astype(np.uint16)
    cv2.imwrite(f"{stem}.color.{suffix}", picture(index, size)[..., ::-1])
    cv2.imwrite(f"{stem}.depth.png", depth)
    # As the set does, with rounded rotations.
    rows = [" ".join(f"{value:.4f}" for value in row) for row in camera_to_world(index)]
    Path(f"{stem}.pose.txt").write_text("\n".join(rows) + "\n")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Scenes `den` (sequences 1 and 2, with lists) and `attic` (sequence 1, without), two small frames each."""
    for folder in ("den/seq-01", "den/seq-02", "attic/seq-01"):
        for index in range(2):
            write_frame(tmp_path / folder, index, size=(48, 64))
    (tmp_path / "den" / "TrainSplit.txt").write_text("sequence1\n")
    (tmp_path / "den" / "TestSplit.txt").write_text("sequence2 \r\n\n")
    return tmp_path


def test_depth_is_carried_into_the_colour_camera(tmp_path: Path):
    for index in range(2):
        write_frame(tmp_path / "den" / "seq-01", index)
    frames = SevenScenes(tmp_path).read("den/seq-01", [1, 0])
    check_frames(frames, "den")
    assert frames.metric
    for position, index in enumerate([1, 0]):
        assert np.array_equal(frames.images[position], picture(index, (480, 640)))
        expected_pose = np.linalg.inv(camera_to_world(index))
        expected_pose[:3, 3] += SHIFT
        np.testing.assert_allclose(frames.extrinsics[position], expected_pose, atol=2e-4)
        np.testing.assert_allclose(frames.intrinsics[position], [[525, 0, 320], [0, 525, 240], [0, 0, 1]])
        truth = wall_depth(np.linalg.inv(expected_pose), 525.0, (480, 640))
        depth = frames.depth[position]
        filled = depth > 0
        assert filled.mean() > 0.7
        # Half a pixel of rounding on the slanted wall, half a millimetre of quantisation, and the pose's rounding.
        np.testing.assert_allclose(depth[filled], truth[filled], atol=4e-3)
        points = unproject(depth, frames.intrinsics[position], frames.extrinsics[position])[filled]
        assert np.abs(points @ NORMAL - DISTANCE).max() < 5e-3
        assert abs((points @ NORMAL - DISTANCE).mean()) < 5e-4


def test_invalid_depth_is_masked_before_it_is_carried_and_the_nearest_point_wins(tmp_path: Path):
    depth = np.zeros((480, 640), np.uint16)
    depth[100:110] = 65535
    depth[200:210] = 10_000
    depth[220:230] = 10_001
    depth[300:400, 320:] = 2000
    depth[300:400, :320] = 1000
    write_frame(tmp_path / "den" / "seq-01", 0, depth=depth)
    carried = SevenScenes(tmp_path).read("den/seq-01", [0]).depth[0]
    np.testing.assert_array_equal(np.unique(carried), np.float32([0, 1, 2, 10]))
    # Shifts: 525 * 0.025 m / z = 13 px at 1 m, 6.6 px at 2 m, so the far half uncovers pixels 307 to 312.
    row = carried[240 + round((350 - 240) * 525 / 585)]
    assert (row[290:307] == 1).all() and (row[307:313] == 0).all() and (row[320:560] > 0).mean() > 0.95
    depth[300:400, :320], depth[300:400, 320:] = 2000, 1000
    write_frame(tmp_path / "den" / "seq-01", 0, depth=depth)
    row = SevenScenes(tmp_path).read("den/seq-01", [0]).depth[0][240 + round((350 - 240) * 525 / 585)]
    assert (row[307:560] == 1).all()


def test_projected_depth_is_preferred_and_taken_as_it_is(root: Path):
    projected = np.full((48, 64), 1500, np.uint16)
    projected[0, :4] = [0, 65535, 10_001, 10_000]
    cv2.imwrite(str(root / "den/seq-01/frame-000000.depth.proj.png"), projected)
    frames = SevenScenes(root).read("den/seq-01", [0])
    np.testing.assert_array_equal(frames.depth[0, 0, :5], np.float32([0, 0, 0, 10, 1.5]))
    np.testing.assert_allclose(frames.extrinsics[0], np.linalg.inv(camera_to_world(0)), atol=1e-6)
    assert frames.intrinsics[0, 0, 0] == 52.5


def test_intrinsics_follow_the_image_size(root: Path):
    frames = SevenScenes(root).read("den/seq-01", [0])
    np.testing.assert_allclose(frames.intrinsics[0], [[52.5, 0, 31.55], [0, 52.5, 23.55], [0, 0, 1]], rtol=1e-6)
    filled = frames.depth[0] > 0
    pose = np.linalg.inv(frames.extrinsics[0].astype(np.float64))
    np.testing.assert_allclose(frames.depth[0][filled], wall_depth(pose, 525.0, (48, 64))[filled], atol=0.02)


def test_splits_follow_the_list_files(root: Path):
    assert SevenScenes(root).sequences == ("attic/seq-01", "den/seq-01", "den/seq-02")
    den = root / "den"
    assert SevenScenes(den).sequences == ("den/seq-01", "den/seq-02")
    assert SevenScenes(den, "train").sequences == ("den/seq-01",)
    assert SevenScenes(den, "test").sequences == ("den/seq-02",)
    with pytest.raises(FileNotFoundError, match=r"attic/TestSplit\.txt.*split='all'"):
        SevenScenes(root, "test")
    (den / "TestSplit.txt").write_text("sequence2\nsequence7\n")
    with pytest.raises(FileNotFoundError, match=r"seq-07.*TestSplit\.txt lists it"):
        SevenScenes(den, "test")
    (den / "TestSplit.txt").write_text("second\n")
    with pytest.raises(ValueError, match=r"TestSplit\.txt.*'second'"):
        SevenScenes(den, "test")


def test_stray_files_do_not_count(root: Path):
    folder = root / "den/seq-01"
    for name in ("frame-000000.color.png.bak", "thumb.color.png", "frame-12.color.png", "camera-intrinsics.txt"):
        (folder / name).write_text("stray")
    assert SevenScenes(root).frame_names("den/seq-01") == ["frame-000000", "frame-000001"]


def test_jpeg_colour_is_accepted(root: Path):
    write_frame(root / "den/seq-03", 4, suffix="jpg", size=(48, 64))
    frames = SevenScenes(root).read("den/seq-03", [0])
    assert np.abs(frames.images[0].astype(int) - picture(4, (48, 64))).max() < 6


def test_a_rendered_room_whose_camera_is_not_the_sets_is_told(root: Path, caplog: pytest.LogCaptureFixture):
    logging.use_python_logging(quiet=True)
    np.savetxt(root / "den/seq-01/intrinsics.txt", np.eye(3))
    assert SevenScenes(root).num_frames("den/seq-01")
    told = "den/seq-01: holds intrinsics.txt, as what `logvggt render-room` writes; it is not read"
    assert told in caplog.text
    caplog.clear()
    assert len(SevenScenes(root).frame_names("den/seq-01")) and told in caplog.text, "from the index"


def test_picture_sizes_are_found_once_and_despite_a_broken_frame(root: Path, monkeypatch: pytest.MonkeyPatch):
    dataset = SevenScenes(root)
    name = dataset.sequences[0]
    first = next(root.rglob(f"{name.split('/')[1]}/frame-000000.color.*"))
    first.write_bytes(first.read_bytes()[:100])
    assert dataset.image_size(name) == (48, 64)
    monkeypatch.setattr(SevenScenes, "read", None)
    assert SevenScenes(root).image_size(name) == (48, 64), "kept in the index"


@pytest.mark.parametrize(("gap", "bound", "overlap"), [(10, 0.009, 0.8), (30, 0.014, 0.55)])
def test_real_frames_agree_with_each_other(seven_scenes_dir: Path, gap: int, bound: float, overlap: float):
    """Depth of one frame carried into another; the raw depth camera's figures are 6.1 mm and 9.3 mm."""
    scenes = open_dataset("seven_scenes", seven_scenes_dir)
    assert scenes.num_frames("redkitchen/seq-01") == 1000
    errors, shares = [], []
    for first in range(40, 900, 140):
        frames = scenes.read("redkitchen/seq-01", [first, first + gap])
        check_frames(frames, "redkitchen")
        relative, share = depth_consistency(frames, 0, 1)
        errors.append(relative * np.median(frames.depth[1][frames.depth[1] > 0]))
        shares.append(share)
    assert np.median(errors) < bound and np.median(shares) > overlap
