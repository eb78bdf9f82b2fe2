"""`check_copy`: each kind of damage is reported by file and counted, the rest goes on, a sound copy is clean."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic_room import camera_to_world
from layouts import tum_recording
from layouts.replica import write, write_camera
from room_views import SIZE, room_views

from logvggt_jax.data.checks.check import check_copy
from logvggt_jax.data.checks.picture import view_from_above


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sound")
    write(folder, room_views(6))
    return folder


@pytest.fixture
def root(sound: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "replica"))


def add(root: Path, name: str) -> Path:
    return Path(shutil.copytree(root / "room0", root / name))


def edit_poses(scene: Path, edit) -> None:
    poses = np.loadtxt(scene / "traj.txt").reshape(-1, 4, 4)
    np.savetxt(scene / "traj.txt", edit(poses).reshape(-1, 16))


def problems_of(report, sequence: str) -> list[tuple[str, str]]:
    return [(problem.kind, problem.message) for problem in report.problems if problem.sequence == sequence]


def test_a_sound_copy_is_clean(root: Path):
    add(root, "room1")
    report = check_copy("replica", root, all_images=True)
    assert report.problems == [] and report.problem_counts() == {}
    assert [sequence.name for sequence in report.sequences] == ["room0", "room1"]
    for sequence in report.sequences:
        assert (sequence.num_frames, sequence.decoded, sequence.image_size) == (6, 6, SIZE)
        assert sequence.consistency < 0.01 and sequence.compared_share > 0.4
        # The room is 6 m long.
        assert 0.3 < sequence.depth.minimum < sequence.depth.median < sequence.depth.maximum < 7
        assert sequence.depth.valid_share == 1
    assert "problems: none" in report.text() and "12 frames" in report.text()


def test_own_recordings_of_other_axes_are_told_what_to_compare(tmp_path: Path):
    tum_recording.write(tmp_path, room_views(5))
    poses = tmp_path / tum_recording.NAME / "groundtruth.txt"
    times_and_poses = np.loadtxt(poses)
    # As OpenGL has them: half a turn about x.
    x, y, z, w = times_and_poses[:, 4:].T
    times_and_poses[:, 4:] = np.stack([w, z, -y, -x], axis=1)
    np.savetxt(poses, times_and_poses)
    ((kind, message),) = problems_of(check_copy("tum_recording", tmp_path), tum_recording.NAME)
    assert kind == "inconsistent depth and poses" and "axes of the poses, the unit of depth or the calib" in message


def test_every_kind_of_damage_is_named_and_counted_and_the_rest_goes_on(root: Path):
    names = ("missing", "truncated", "undecodable", "sizes", "frame_sizes", "short", "scaled", "words", "lost", "empty")
    scenes = {name: add(root, name) for name in (*names, "bare", "swapped")}
    results = {name: scene / "results" for name, scene in scenes.items()}
    for name in ("depth000001.png", "frame000003.jpg", "frame000004.jpg"):
        (results["missing"] / name).unlink()
    picture = results["truncated"] / "frame000002.jpg"
    picture.write_bytes(picture.read_bytes()[:-200])
    (results["undecodable"] / "depth000005.png").write_bytes(b"no picture")
    depth = cv2.imread(str(root / "room0/results/depth000000.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(results["sizes"] / "depth000001.png"), depth[:-2])
    cv2.imwrite(str(results["frame_sizes"] / "depth000001.png"), depth[:-2])
    cv2.imwrite(str(results["frame_sizes"] / "frame000001.jpg"), np.zeros((SIZE[0] - 2, SIZE[1], 3), np.uint8))
    edit_poses(scenes["short"], lambda poses: poses[:-1])
    edit_poses(scenes["scaled"], lambda poses: poses * 1.5)
    (scenes["words"] / "traj.txt").write_text("no numbers\n" * 6)
    edit_poses(scenes["lost"], lambda poses: np.where(np.arange(6)[:, None, None] == 2, np.nan, poses))
    edit_poses(scenes["empty"], lambda poses: poses * np.nan)
    for file in results["bare"].iterdir():
        file.unlink()
    edit_poses(scenes["swapped"], np.linalg.inv)

    report = check_copy("replica", root, all_images=True)
    assert {s.name for s in report.sequences} == {"room0", *scenes}
    assert problems_of(report, "room0") == problems_of(report, "lost") == []
    for name, kind, *files in (
        ("missing", "missing file", "depth000001.png", "frame000003.jpg", "frame000004.jpg"),
        ("truncated", "broken picture", "frame000002.jpg"),
        ("undecodable", "broken picture", "depth000005.png"),
        ("sizes", "unequal sizes", "depth000001.png"),
        ("frame_sizes", "unequal sizes", "frame000001.jpg"),
        ("short", "unequal counts", "traj.txt"),
        ("scaled", "pose that is no rotation", "traj.txt, line 1"),
        ("words", "damaged file", "traj.txt, line 1"),
        ("empty", "empty sequence", "empty"),
        ("bare", "missing file", "results"),
        ("swapped", "inconsistent depth and poses", "swapped"),
    ):
        found = problems_of(report, name)
        assert [problem[0] for problem in found] == [kind] * len(files), found
        for (_, message), file in zip(found, files, strict=True):
            assert message.startswith(str(root)) and file in message and "\n" not in message
            # Each says what to do.
            assert re.search(r"fetch|unpack|remove", message), message
    counts = report.problem_counts()
    assert counts.pop("missing file") == 4
    assert counts.pop("broken picture") == counts.pop("unequal sizes") == 2
    assert set(counts.values()) == {1} and len(counts) == 5
    assert report.dropped_counts() == {"no pose": 1}
    by_name = {sequence.name: sequence for sequence in report.sequences}
    # What is not broken is still decoded.
    assert [by_name[n].decoded for n in ("truncated", "sizes", "frame_sizes", "lost", "scaled")] == [5, 5, 5, 5, 0]
    assert by_name["missing"].num_frames == 0
    text = report.text()
    assert all(problem.message in text for problem in report.problems)


def test_absurd_intrinsics_are_reported_for_every_frame_and_the_text_is_cut(root: Path):
    write_camera(root, fx=4e5, fy=4e5)
    report = check_copy("replica", root, all_images=True)
    assert report.problem_counts() == {"absurd intrinsics": 6}
    assert all("calibration" in problem.message for problem in report.problems)
    assert report.text().count("cannot belong to a picture") == 3 and "3 more; --json" in report.text()
    assert sum(len(s["problems"]) for s in report.as_json()["sequences"]) == 6


def test_a_sample_is_decoded_unless_all_images_are_asked_for(tmp_path: Path):
    write(tmp_path, room_views(12))
    (tmp_path / "room0/results/frame000001.jpg").write_bytes(b"")
    report = check_copy("replica", tmp_path)
    assert report.problems == [] and report.sequences[0].decoded == 5
    report = check_copy("replica", tmp_path, all_images=True)
    assert report.problem_counts() == {"broken picture": 1} and report.sequences[0].decoded == 11


def test_max_sequences_are_spread_over_the_set(root: Path):
    for index in range(1, 7):
        add(root, f"room{index}")
    report = check_copy("replica", root, max_sequences=3)
    assert [sequence.name for sequence in report.sequences] == ["room0", "room3", "room6"]
    assert report.sequences_in_split == 7 and "3 of 7 sequences" in report.text()
    assert [s.name for s in check_copy("replica", root, max_sequences=1).sequences] == ["room3"]


def test_sets_without_poses_have_no_consistency_and_frames_without_depth_are_counted(tmp_path: Path):
    drive, date = "2011_09_26_drive_0002_sync", "2011_09_26"
    depth, images = (
        tmp_path / f"val/{drive}/proj_depth/groundtruth/image_02",
        tmp_path / f"{date}/{drive}/image_02/data",
    )
    depth.mkdir(parents=True)
    images.mkdir(parents=True)
    for index in range(3):
        cv2.imwrite(str(images / f"{index:010d}.png"), room_views(1)[0].picture)
        cv2.imwrite(str(depth / f"{index:010d}.png"), np.full(SIZE, 256 * 5 * (index > 0), np.uint16))
    (tmp_path / date / "calib_cam_to_cam.txt").write_text("P_rect_02: 50 0 32 0 0 50 24 0 0 0 1 0\n")
    report = check_copy("kitti", tmp_path, picture=tmp_path / "check.png")
    (sequence,) = report.sequences
    assert report.problems == [] and not sequence.has_poses and sequence.consistency is None
    assert sequence.without_depth == 1 and sequence.depth.median == 5
    assert sequence.depth.valid_share == pytest.approx(2 / 3)
    assert "no figure" in report.text() and "1 without depth" in report.text()
    assert cv2.imread(str(tmp_path / "check.png")) is not None


def test_the_picture_has_a_row_for_each_sequence(root: Path):
    add(root, "broken")
    (root / "broken/traj.txt").unlink()
    add(root, r"$\frac$")  # no formula
    check_copy("replica", root, picture=root.parent / "check.png")
    picture = cv2.imread(str(root.parent / "check.png"))
    assert picture.shape == (2 * 330, 1650, 3)
    # Both rows show something in each of their five columns.
    assert (picture.reshape(2, 330, 5, 330, 3).std((1, 3)) > 5).all()
    assert sorted(file.name for file in root.parent.iterdir()) == ["check.png", "replica"]


def test_nothing_to_draw_is_a_warning_and_the_report_comes(root: Path):
    (root / "room0/traj.txt").unlink()
    with pytest.warns(UserWarning, match="not written"):
        report = check_copy("replica", root, picture=root.parent / "check.png")
    assert report.problem_counts() == {"missing file": 1}


def test_from_above_means_against_the_cameras_upward_direction():
    poses = np.stack([camera_to_world(index) for index in range(8)])
    right, up = view_from_above(np.linalg.inv(poses))
    # The room's y axis points down: seen from above, right x up on the page points out of it.
    np.testing.assert_allclose(np.cross(right, up), [0, -1, 0], atol=0.1)
    assert abs(right @ up) < 1e-9 and np.linalg.norm(right) == pytest.approx(1)
    assert view_from_above(np.eye(4)[None]).shape == (2, 3)


def test_wrong_requests_are_refused(root: Path, tmp_path: Path):
    for error, match, arguments in (
        (ValueError, "unknown data set 'x'", {"name": "x"}),
        (ValueError, "no copy to check", {"name": "rooms"}),
        (ValueError, "max_sequences must be at least 1, got 0", {"max_sequences": 0}),
        (ValueError, "no split 'test'", {"split": "test"}),
        (ValueError, "PNG", {"picture": tmp_path / "check.jpg"}),
        (FileNotFoundError, "nowhere", {"picture": tmp_path / "nowhere/check.png"}),
        (FileNotFoundError, "nowhere", {"root": tmp_path / "nowhere"}),
    ):
        with pytest.raises(error, match=match):
            check_copy(**({"name": "replica", "root": root} | arguments))


@pytest.mark.parametrize("kind", [ImportError, MemoryError])
def test_what_is_no_fault_of_the_copy_ends_the_check(root: Path, kind: type, monkeypatch: pytest.MonkeyPatch):
    """A missing package, or too little memory: it would be reported for every frame."""

    def read(*_: object) -> None:
        raise kind("more is needed")

    monkeypatch.setattr("logvggt_jax.data.readers.replica.read_depth", read)
    with pytest.raises(kind, match="more is needed"):
        check_copy("replica", root)


def test_errors_of_the_reader_itself_do_not_end_the_check(root: Path, monkeypatch: pytest.MonkeyPatch):
    def read(*_: object) -> None:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr("logvggt_jax.data.readers.replica.read_depth", read)
    report = check_copy("replica", root)
    assert report.problem_counts() == {"unexpected error": 1}
    assert "room0: ZeroDivisionError: by zero" in report.problems[0].message
