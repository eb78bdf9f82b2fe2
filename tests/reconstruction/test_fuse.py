"""A map rebuilt from better cameras: on a room whose truth is known, with cameras and depth put out of order."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from room_result import changed, write_room_result

from logvggt_jax.cli import main
from logvggt_jax.errors import InputError, MissingPackage, OutputExists
from logvggt_jax.geometry import (
    Similarity,
    camera_centres,
    pose_similarity,
    quaternion_to_matrix,
    rotation_angle,
)
from logvggt_jax.reconstruction import PointFilter, Reconstruction, export, fuse, write_trajectory
from logvggt_jax.reconstruction.fusion.bundle_adjustment import _largest_steps
from logvggt_jax.reconstruction.fusion.matching import match_poses
from logvggt_jax.reconstruction.fusion.pose_files import ExternalPose, read_poses
from logvggt_jax.reconstruction.fusion.rescale import rescale
from logvggt_jax.reconstruction.sources.record import SourceRecord

COUNT, SIZE = 10, (84, 112)
# From the room's metres to the disordered result's world.
WORLD = Similarity(0.4, quaternion_to_matrix(np.array([0.1, 0.7, -0.2, 0.6])), np.array([0.5, -1.0, 2.0]))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    folder = tmp_path_factory.mktemp("truth")
    return write_room_result(folder, count=COUNT, size=SIZE, image_size=SIZE, seed=2, clutter=30, period=192)


@pytest.fixture(scope="module")
def growth() -> np.ndarray:
    """What every frame's depth was multiplied by, beside the world's scale."""
    logarithms = 0.1 * np.random.default_rng(0).normal(size=COUNT)
    return np.exp(logarithms - logarithms.mean())


@pytest.fixture(scope="module")
def disordered(truth: Reconstruction, growth: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    """The room in another world, its cameras off by about 5 mm and a degree, its depth by a tenth."""
    cameras = WORLD.apply_to_extrinsics(shaken(truth.extrinsics, 0.003))
    return changed(truth, tmp_path_factory.mktemp("disordered") / "result", cameras, WORLD.scale * growth)


def shaken(extrinsics: np.ndarray, metres: float) -> np.ndarray:
    """Cameras off by about a degree, and by so much along each axis."""
    generator = np.random.default_rng(1)
    turns = np.concatenate(
        [np.radians(0.3) * generator.normal(size=(len(extrinsics), 3)), np.ones((len(extrinsics), 1))], 1
    )
    rotations = quaternion_to_matrix(turns) @ extrinsics[:, :3, :3]
    centres = camera_centres(extrinsics) + metres * generator.normal(size=(len(extrinsics), 3))
    return np.concatenate([rotations, -(rotations @ centres[:, :, None])], axis=2)


def with_colmap(truth: Reconstruction, folder: Path) -> Path:
    pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    return export(truth, ["colmap"], folder, point_filter=PointFilter(max_points=50), progress=False)[0]


def with_colmap_text(truth: Reconstruction, folder: Path) -> Path:
    pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    (made,) = export(truth, ["colmap-text"], folder, point_filter=PointFilter(max_points=50), progress=False)
    return made / "sparse" / "0"


def with_nerfstudio(truth: Reconstruction, folder: Path) -> Path:
    return export(truth, ["nerfstudio"], folder, progress=False)[0] / "transforms.json"


def with_tum(truth: Reconstruction, folder: Path) -> Path:
    return export(truth, ["tum"], folder, progress=False)[0]


@pytest.mark.parametrize("write", [with_colmap, with_colmap_text, with_nerfstudio, with_tum])
def test_cameras_of_other_programs_are_read(
    truth: Reconstruction, tmp_path: Path, write: Callable[[Reconstruction, Path], Path]
) -> None:
    path = write(truth, tmp_path / "poses")
    matched = match_poses(truth, read_poses(path), path)
    assert list(matched) == list(range(COUNT))
    for index, pose in matched.items():
        np.testing.assert_allclose(pose.extrinsics[:3], truth.extrinsics[index], atol=1e-6)
        if write is not with_tum:
            np.testing.assert_allclose(pose.intrinsics, truth.intrinsics[index], rtol=1e-9)
            assert pose.size == SIZE


def test_with_true_poses_depth_and_points_come_out_true(
    truth: Reconstruction, disordered: Reconstruction, tmp_path: Path
) -> None:
    poses = with_tum(truth, tmp_path / "poses")
    made, notes = fuse(disordered, tmp_path / "fused", poses=poses, metric=True, progress=False)
    assert made.metric and made.names == truth.names
    assert made.world_is_given and not disordered.world_is_given
    scaled, _ = rescale(made, tmp_path / "scaled", frames=("0", "1"), distance=1.0, progress=False)
    assert scaled.world_is_given
    np.testing.assert_allclose(made.extrinsics, truth.extrinsics, atol=1e-6)
    ratios = [np.median(made.depth(index) / truth.depth(index)) for index in range(COUNT)]
    assert np.mean(ratios) == pytest.approx(1, abs=0.02)
    assert np.std(ratios) < 0.01, "frames agree with one another, whatever was done to their depth"
    points, _ = made.points()
    assert len(points) > 10_000
    assert disordered.health is None and made.health is not None
    assert np.isfinite(made.health.measures.overlap[1:]).all() and not made.health.doubtful.any()
    text = "\n".join(notes)
    assert "similarity: scale" in text and "turned by" in text and "depth: scaled by" in text


def test_intrinsics_that_come_with_the_poses_are_taken(truth: Reconstruction, tmp_path: Path) -> None:
    wrong = changed(truth, tmp_path / "wrong", truth.extrinsics, np.ones(COUNT), focal=1.2)
    poses = with_nerfstudio(truth, tmp_path)
    made, _ = fuse(wrong, tmp_path / "fused", poses=poses, progress=False)
    np.testing.assert_allclose(made.intrinsics, truth.intrinsics, rtol=1e-9)
    np.testing.assert_allclose(made.depth_intrinsics, truth.depth_intrinsics, rtol=1e-9)
    document = json.loads(poses.read_text())
    for key, value in (("k1", 0.1), ("camera_model", "OPENCV_FISHEYE")):
        poses.write_text(json.dumps({**document, key: value}))
        made, notes = fuse(wrong, tmp_path / "kept", poses=poses, overwrite=True, progress=False)
        np.testing.assert_allclose(made.intrinsics, wrong.intrinsics, rtol=1e-9)
        assert any("intrinsics stay the result's" in note for note in notes)


def test_intrinsics_of_pictures_that_frames_are_parts_of_are_not_taken(truth: Reconstruction, tmp_path: Path) -> None:
    poses = with_nerfstudio(truth, tmp_path)
    document = json.loads(poses.read_text())
    for frame in document["frames"]:
        frame.update(w=2 * frame["w"], h=2 * frame["h"], cx=2 * frame["cx"], cy=2 * frame["cy"])
    poses.write_text(json.dumps(document))
    cut = dataclasses.replace(truth, source=SourceRecord("photos", {"size_mismatch": "crop"}, COUNT, ""))
    made, notes = fuse(cut, tmp_path / "fused", poses=poses, progress=False)
    np.testing.assert_array_equal(made.intrinsics, truth.intrinsics)
    assert any("intrinsics stay the result's" in note for note in notes)
    made, _ = fuse(truth, tmp_path / "whole", poses=poses, progress=False)
    np.testing.assert_allclose(made.intrinsics[:, 0, 0], truth.intrinsics[:, 0, 0] / 2)


@pytest.mark.parametrize("lens", [{}, {"k1": 0.1}])
def test_poses_of_pictures_that_lie_on_their_side_are_refused(
    truth: Reconstruction, tmp_path: Path, lens: dict[str, float]
) -> None:
    poses = with_nerfstudio(truth, tmp_path)
    document = json.loads(poses.read_text())
    for frame in document["frames"]:
        frame.update(w=frame["h"], h=frame["w"], cx=frame["cy"], cy=frame["cx"], **lens)
    poses.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"frame view 0 has 84 x 112 pixels there, and 112 x 84 here, where it was "):
        fuse(truth, tmp_path / "fused", poses=poses, progress=False)
    assert not (tmp_path / "fused").exists()


@pytest.mark.parametrize(
    ("axes", "clockwise", "how"),
    [
        ([1, 1, 1], 90, "pictures that have to be turned clockwise by 90 degrees"),
        ([1, 1, 1], 180, "pictures that have to be turned clockwise by 180 degrees"),
        ([1, 1, 1], 270, "pictures that have to be turned clockwise by 270 degrees"),
        ([1, -1, -1], 0, r"OpenGL's axes \(y up, z backward\): give cameras"),
        ([1, -1, -1], 90, r"z backward\) and pictures that have to be turned clockwise by 90 degrees"),
    ],
)
def test_poses_of_turned_cameras_are_refused(
    truth: Reconstruction, disordered: Reconstruction, tmp_path: Path, axes: list[int], clockwise: int, how: str
) -> None:
    """A phone's poses are of its sensor, which lies on its side, and programs of graphics have OpenGL's axes."""
    back = np.radians(-clockwise)
    turn = np.array([[np.cos(back), -np.sin(back), 0], [np.sin(back), np.cos(back), 0], [0, 0, 1]])
    poses = tmp_path / "poses.txt"
    write_trajectory(poses, truth.timestamps, np.diag(axes) @ turn @ truth.extrinsics)
    with pytest.raises(InputError, match=how):
        fuse(disordered, tmp_path / "fused", poses=poses, progress=False)
    assert not (tmp_path / "fused").exists()


def test_frames_without_a_pose_and_poses_without_a_frame_are_said(
    truth: Reconstruction, disordered: Reconstruction, tmp_path: Path
) -> None:
    times = np.concatenate([truth.timestamps[:6] + 0.01, [99.0]])
    write_trajectory(tmp_path / "poses.txt", times, truth.extrinsics[[0, 1, 2, 3, 4, 5, 0]])
    made, notes = fuse(disordered, tmp_path / "fused", poses=tmp_path / "poses.txt", progress=False)
    assert made.names == truth.names[:6] and not made.metric
    text = "\n".join(notes)
    assert "4 of 10 frames have no pose: view 6" in text and "frames without a pose are left out" in text
    assert "1 of 7 poses belong to no frame" in text
    assert made.health is not None and len(made.health.doubtful) == 6
    assert made.source is None and Reconstruction.open(disordered.folder).num_frames == COUNT


def test_bundle_adjustment_brings_cameras_nearer_to_the_truth(truth: Reconstruction, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    start = changed(truth, tmp_path / "start", shaken(truth.extrinsics, 0.015), np.ones(COUNT))

    def errors(result: Reconstruction) -> tuple[float, float]:
        moved = pose_similarity(result.extrinsics, truth.extrinsics).apply_to_extrinsics(result.extrinsics)
        distances = np.linalg.norm(camera_centres(moved) - camera_centres(truth.extrinsics), axis=1)
        angles = np.degrees(rotation_angle(moved[:, :3, :3], truth.extrinsics[:, :, :3]))
        return float(distances.mean()), float(angles.mean())

    made, notes = fuse(start, tmp_path / "adjusted", adjust=True, progress=False)
    (distance, angle), (before, turned) = errors(made), errors(start)
    assert distance < before / 2 and angle < turned / 2
    np.testing.assert_array_equal(made.intrinsics, start.intrinsics)
    found = pose_similarity(made.extrinsics, start.extrinsics)
    assert found.scale == pytest.approx(1, abs=1e-3), "the world keeps its scale"
    assert any("bundle adjustment:" in note and "before" in note for note in notes)
    assert any(note.startswith("between neighbours cameras turn by up to") for note in notes)


def test_an_adjustment_that_tears_neighbours_apart_is_refused(truth: Reconstruction, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    # Corners are followed with cameras that have nothing to do with the images, so that few are left, by chance.
    start = changed(truth, tmp_path / "start", shaken(truth.extrinsics, 0.3), np.ones(COUNT))
    with pytest.raises(InputError, match=r"bundle adjustment of .*start (did not hold|found \d+ corners).*"):
        fuse(start, tmp_path / "adjusted", adjust=True, progress=False)
    assert not (tmp_path / "adjusted").exists()


def test_the_largest_change_between_neighbours_is_found(truth: Reconstruction) -> None:
    after = truth.extrinsics.copy()
    assert _largest_steps(truth.extrinsics, after) == pytest.approx((0.0, 0.0), abs=1e-4)
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    after[4, :, :3] = turn @ after[4, :, :3]
    centres = camera_centres(truth.extrinsics)
    after[4, :, 3] = -after[4, :, :3] @ centres[4]
    turned, shifted = _largest_steps(truth.extrinsics, after)
    assert turned == pytest.approx(np.degrees(0.3), rel=1e-3) and shifted < 1e-6
    after[7:, :, 3] -= after[7:, :, :3] @ (centres[7] - centres[6])
    size = np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1))
    _, shifted = _largest_steps(truth.extrinsics, after)
    assert shifted == pytest.approx(np.linalg.norm(centres[7] - centres[6]) / size, rel=1e-3)


def test_paths_that_are_not_alike_give_a_scale_and_a_word_on_it(truth: Reconstruction, tmp_path: Path) -> None:
    """Better poses are wanted most where the result's are bad: those are no reason to refuse them."""
    bad = changed(truth, tmp_path / "bad", shaken(truth.extrinsics, 0.5), np.full(COUNT, 1.0))
    poses = with_tum(truth, tmp_path / "poses")
    made, notes = fuse(bad, tmp_path / "fused", poses=poses, progress=False)
    np.testing.assert_allclose(made.extrinsics, truth.extrinsics, atol=1e-6)
    assert any("the two paths are not alike, and the scale is a guess" in note for note in notes)
    _, notes = fuse(truth, tmp_path / "again", poses=poses, progress=False)
    assert not any("guess" in note for note in notes)


def test_images_that_show_nothing_move_no_camera(truth: Reconstruction, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    from logvggt_jax.reconstruction.depth_files import write_picture

    blank = changed(truth, tmp_path / "blank", truth.extrinsics, np.ones(COUNT))
    for file in (blank.folder / "images").iterdir():
        write_picture(file, np.full((*SIZE, 3), 128, np.uint8))
    with pytest.raises(InputError, match="too few to move a camera"):
        fuse(blank, tmp_path / "out", adjust=True, progress=False)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("1000 0 0 0 0 0 0 1\n1001 1 0 0 0 0 0 1\n", r"its times, 1000 to 1001, are none of the frames', 0 to 1\.125"),
        ("0 0 0 0 0 0 0 1\n", "needs? at least 2"),
        ("0 1 1 1 0 0 0 1\n0.125 1 1 1 0 0 0 1\n", "all at one place"),
        ("0 1 1\n", "poses.txt:1: expected 8 numbers"),
        ("", "holds no pose"),
    ],
)
def test_poses_that_tell_nothing_are_refused(
    disordered: Reconstruction, tmp_path: Path, content: str, complaint: str
) -> None:
    (tmp_path / "poses.txt").write_text(content)
    with pytest.raises(InputError, match=complaint) as caught:
        fuse(disordered, tmp_path / "out", poses=tmp_path / "poses.txt", progress=False)
    assert "\n" not in str(caught.value) and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("{", "is no transforms.json"),
        ("[]", "is no transforms.json"),
        ('{"frames": [{"file_path": "a.png"}]}', "no 'transform_matrix'"),
        ('{"frames": [{"file_path": "a.png", "transform_matrix": [[1]]}]}', r"must be \[4, 4\] finite numbers"),
        ('{"frames": []}', "holds no pose"),
    ],
)
def test_damaged_transforms_are_refused(
    disordered: Reconstruction, tmp_path: Path, content: str, complaint: str
) -> None:
    (tmp_path / "transforms.json").write_text(content)
    with pytest.raises(InputError, match=complaint) as caught:
        fuse(disordered, tmp_path / "out", poses=tmp_path, progress=False)
    assert "\n" not in str(caught.value)


def test_names_that_match_no_frame_are_shown(truth: Reconstruction, disordered: Reconstruction, tmp_path: Path) -> None:
    poses = with_nerfstudio(truth, tmp_path)
    poses.write_text(poses.read_text().replace("view_", "photo"))
    with pytest.raises(
        InputError, match=r"none of its 10 pictures \('images/photo0.jpg', …\) has the name of one of the 10 frames"
    ):
        fuse(disordered, tmp_path / "out", poses=poses, progress=False)


@pytest.mark.parametrize(
    ("frames", "pictures"),
    [
        # As 7-Scenes names colour, and as pictures of several folders are called.
        (["frame-000000", "frame-000001"], ["frame-000000.color.png", "frame-000001.color.png"]),
        (["a_0000.jpg", "b_0000.jpg"], ["a/0000.jpg", "b/0000.jpg"]),
        (["0000.jpg", "0000.png"], ["images/0000.jpg", "images/0000.png"]),
        (["0000", "0001"], ["left/0000.jpg", "left/0001.jpg"]),
        # One agrees in an earlier form, all in a later one.
        (["1", "2", "3"], ["1", "2.jpg", "3.jpg"]),
    ],
)
def test_a_picture_is_its_frame_whatever_made_the_frames_name(
    truth: Reconstruction, frames: list[str], pictures: list[str]
) -> None:
    named = dataclasses.replace(truth, names=tuple(frames))
    poses = [ExternalPose(name, None, np.eye(4)) for name in reversed(pictures)]
    matched = match_poses(named, poses, "poses")
    assert [matched[index].name for index in range(len(frames))] == pictures


def test_poses_of_several_cameras_under_one_name_are_refused(
    truth: Reconstruction, disordered: Reconstruction, tmp_path: Path
) -> None:
    poses = with_nerfstudio(truth, tmp_path)
    poses.write_text(poses.read_text().replace("view_3", "view_2"))
    with pytest.raises(InputError, match=r"several of its pictures are named 'view_2', .* poses of one camera"):
        fuse(disordered, tmp_path / "out", poses=poses, progress=False)


def test_of_several_colmap_models_the_largest_is_taken_and_said(truth: Reconstruction, tmp_path: Path) -> None:
    for place, count in (("0", 2), ("2", COUNT)):
        lines = [
            f"{i} 1 0 0 0 {' '.join(map(str, pose[:, 3]))} 1 {name}.png\n\n"
            for i, (name, pose) in enumerate(zip(truth.names, truth.extrinsics, strict=True))
        ]
        (tmp_path / "sparse" / place).mkdir(parents=True)
        (tmp_path / "sparse" / place / "images.txt").write_text("".join(lines[:count]))
        (tmp_path / "sparse" / place / "cameras.txt").write_text("1 PINHOLE 56 42 50 50 28 21\n")
    for folder in (tmp_path, tmp_path / "sparse"):
        with pytest.warns(UserWarning, match=f"holds 2 models.*0: 2, 2: {COUNT}.* those of 2, the largest"):
            assert len(read_poses(folder)) == COUNT


def test_a_folder_without_poses_and_targets_in_the_way(
    disordered: Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"expected transforms\.json, or COLMAP's images\.bin"):
        fuse(disordered, tmp_path / "out", poses=tmp_path / "empty")
    with pytest.raises(InputError, match=r"nowhere\.txt does not exist: expected a COLMAP"):
        fuse(disordered, tmp_path / "out", poses=tmp_path / "nowhere.txt")
    with pytest.raises(OutputExists, match="--overwrite"):
        fuse(disordered, disordered.folder, poses=tmp_path / "empty")
    with pytest.raises(InputError, match="is the result itself"):
        fuse(disordered, disordered.folder, poses=tmp_path / "empty", overwrite=True)
    with pytest.raises(InputError, match="nothing to fuse"):
        fuse(disordered, tmp_path / "out")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(MissingPackage, match=r'pip install "logvggt-jax\[colmap\]"'):
        fuse(disordered, tmp_path / "out", adjust=True)


def test_the_command_says_how_well_it_fits(
    truth: Reconstruction, disordered: Reconstruction, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = with_tum(truth, tmp_path)
    assert main(["fuse", str(disordered.folder), "--poses", str(poses), "--output", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "similarity: scale" in printed and "cameras.json" in printed
    assert main(["fuse", str(disordered.folder), "--output", str(tmp_path / "out2")]) == 2
    assert capsys.readouterr().err.startswith("logvggt: error: nothing to fuse")


def test_one_frame_has_no_scale(tmp_path: Path) -> None:
    one = write_room_result(tmp_path / "one", count=1, size=(42, 56), image_size=(42, 56))
    write_trajectory(tmp_path / "poses.txt", one.timestamps, one.extrinsics)
    with pytest.raises(InputError, match="at least 2"):
        fuse(one, tmp_path / "out", poses=tmp_path / "poses.txt")
