"""Metres from what is known of a scene."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from room_result import changed, write_room_result

from logvggt_jax.cli import main
from logvggt_jax.errors import InputError
from logvggt_jax.geometry import camera_centres, unproject
from logvggt_jax.reconstruction import Reconstruction, rescale, write_trajectory
from logvggt_jax.reconstruction.depth_files import write_picture
from logvggt_jax.reconstruction.exporters import export
from logvggt_jax.reconstruction.fusion.rescale import find_frame
from logvggt_jax.reconstruction.points.cloud_file import count_points
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.sources.record import SourceRecord

COUNT, SCALE = 4, 0.25


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    return write_room_result(tmp_path_factory.mktemp("truth"), count=COUNT)


@pytest.fixture(scope="module")
def result(truth: Reconstruction, tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    """The room at a quarter of its size."""
    cameras = truth.extrinsics * [1, 1, 1, SCALE]
    return changed(truth, tmp_path_factory.mktemp("small") / "result", cameras, np.full(COUNT, SCALE))


def assert_true(made: Reconstruction, truth: Reconstruction, tolerance: float = 1e-3) -> None:
    assert made.metric
    np.testing.assert_allclose(made.extrinsics, truth.extrinsics, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(made.depth(2), truth.depth(2), rtol=2e-3 + tolerance)
    np.testing.assert_array_equal(made.intrinsics, truth.intrinsics)
    assert made.num_points > 1000


def test_from_the_distance_of_two_frames(truth: Reconstruction, result: Reconstruction, tmp_path: Path) -> None:
    first, *_, last = camera_centres(truth.extrinsics)
    distance = float(np.linalg.norm(last - first))
    made, notes = rescale(result, tmp_path / "a", frames=("0", "view 3"), distance=distance, progress=False)
    assert_true(made, truth)
    assert "all lengths are multiplied by 4" in notes[-1]


def test_a_frames_number_may_be_one_of_python(result: Reconstruction) -> None:
    assert [find_frame(result, number) for number in (0, np.int64(COUNT - 1))] == [0, COUNT - 1]
    with pytest.raises(InputError, match="there is no frame -1: give a name such as 'view 0', or a number from 0 to 3"):
        find_frame(result, -1)


@pytest.mark.parametrize("metres", [1e9, 1e-9])
def test_a_unit_in_which_files_hold_no_depth_is_refused(result: Reconstruction, tmp_path: Path, metres: float) -> None:
    with pytest.raises(InputError, match=r"view 0: its depth would be .* and files of depth hold 6e-05 to 65504: give"):
        rescale(result, tmp_path / "out", frames=("0", "3"), distance=metres, progress=False)
    assert not list(tmp_path.iterdir())


def test_from_the_distance_of_two_pixels(truth: Reconstruction, result: Reconstruction, tmp_path: Path) -> None:
    (height, width), (rows, columns) = truth.image_size, truth.depth_size
    points = unproject(truth.depth(1), truth.depth_intrinsics[1], truth.extrinsics[1])
    distance = float(np.linalg.norm(points[30, 50] - points[5, 8]))
    pixels = [
        f"view 1,{(u + 0.5) * width / columns - 0.5},{(v + 0.5) * height / rows - 0.5}" for v, u in ((5, 8), (30, 50))
    ]
    made, notes = rescale(result, tmp_path / "a", pixels=(pixels[0], pixels[1]), distance=distance, progress=False)
    assert_true(made, truth)
    assert len(notes) == 2
    cut = dataclasses.replace(result, source=SourceRecord("photos", {"size_mismatch": "crop"}, COUNT, ""))
    _, notes = rescale(cut, tmp_path / "b", pixels=(pixels[0], pixels[1]), distance=distance, progress=False)
    assert notes[1] == "pixels are counted in the frames as they were cut, 128 x 96 from the centre"


def test_a_pixels_point_is_on_its_own_ray(truth: Reconstruction, result: Reconstruction, tmp_path: Path) -> None:
    """A depth map of 56 pixels a row has one for columns 41 and 42 of the picture's 128."""
    rows, columns = truth.depth_size
    places = {(int(50.5 * rows / 96), int((u + 0.5) * columns / 128)) for u in (41, 42)}
    (place,) = places
    apart = result.depth(1)[place] / result.intrinsics[1, 0, 0]
    _, notes = rescale(result, tmp_path / "a", pixels=("1,41,50", "1,42,50"), distance=1.0, progress=False)
    np.testing.assert_allclose(float(notes[-1].split()[-1]), 1 / apart, rtol=1e-4)


def test_from_a_sensors_depth(truth: Reconstruction, result: Reconstruction, tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    for index in (0, 2):
        # Half of the pixels know nothing, some are wrong.
        millimetres = np.rint(truth.depth(index) * 1000).astype(np.uint16)
        millimetres[:, ::2], millimetres[:8] = 0, 500
        write_picture(tmp_path / "depth" / f"view {index}.depth.png", millimetres)
    made, notes = rescale(result, tmp_path / "a", depth=tmp_path / "depth", progress=False)
    assert_true(made, truth, 2e-3)
    assert "sensor depth of 2 of 4 frames" in notes[0] and "%" in notes[0]


def test_depth_that_does_not_show_what_the_frames_show_is_refused(
    truth: Reconstruction, result: Reconstruction, tmp_path: Path
) -> None:
    (tmp_path / "depth").mkdir()
    millimetres = np.rint(truth.depth(0) * 1000).astype(np.uint16)
    write_picture(tmp_path / "depth" / "view 0.png", np.rot90(millimetres))
    told = r"view 0.png has 42 x 56 pixels and does not show what frame view 0 shows, which has 128 x 96: turn or cut"
    with pytest.raises(InputError, match=told):
        rescale(result, tmp_path / "a", depth=tmp_path / "depth", progress=False)
    # Of the whole picture, where the frame may be a part of it.
    write_picture(tmp_path / "depth" / "view 0.png", millimetres)
    cut = dataclasses.replace(result, source=SourceRecord("photos", {"size_mismatch": "crop"}, COUNT, ""))
    with pytest.raises(InputError, match=r"view 0.png has 56 x 42 pixels and does not show"):
        rescale(cut, tmp_path / "a", depth=tmp_path / "depth", progress=False)
    assert not (tmp_path / "a").exists()


def test_depth_is_found_beside_colour(truth: Reconstruction, result: Reconstruction, tmp_path: Path) -> None:
    for index in range(COUNT):
        write_picture(tmp_path / f"view {index}.color.png", truth.image(index))
        write_picture(tmp_path / f"view {index}.depth.png", np.rint(truth.depth(index) * 1000).astype(np.uint16))
    (tmp_path / "others.png").mkdir()
    made, notes = rescale(result, tmp_path / "a", depth=tmp_path, progress=False)
    assert_true(made, truth, 2e-3)
    assert "sensor depth of 4 of 4 frames" in notes[0]


def test_the_points_are_chosen_as_before_and_health_stays(result: Reconstruction, tmp_path: Path) -> None:
    chosen = {"confidence_percentile": 60.0, "edge_threshold": None, "pixel_stride": 2, "max_points": None}
    few = tmp_path / "few"
    shutil.copytree(result.folder, few)
    document = json.loads((few / "cameras.json").read_text())
    (few / "cameras.json").write_text(json.dumps({**document, "points": chosen}))
    for name in ("health.json", "health.html"):
        (few / name).write_text(name)
    made, _ = rescale(Reconstruction.open(few), tmp_path / "a", frames=("0", "3"), distance=1.0, progress=False)
    assert made.point_filter == PointFilter(**chosen)
    (own,) = export(Reconstruction.open(few), ["ply"], tmp_path / "own", progress=False)
    everything = export(result, ["ply"], tmp_path / "all", point_filter=PointFilter(max_points=None), progress=False)
    assert made.num_points == count_points(own) < count_points(everything[0]) / 3
    assert (made.folder / "health.html").read_text() == "health.html"


def test_from_poses_in_metres(truth: Reconstruction, result: Reconstruction, tmp_path: Path) -> None:
    write_trajectory(tmp_path / "poses.txt", truth.timestamps, truth.extrinsics)
    made, notes = rescale(result, tmp_path / "a", poses=tmp_path / "poses.txt", progress=False)
    assert_true(made, truth)
    assert "similarity: scale 4" in notes[0]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"frames": ("0", "1"), "distance": 0.0}, "a distance must be above 0 metres, got 0"),
        ({"frames": ("0", "1"), "distance": float("nan")}, "above 0"),
        ({"frames": ("0", "1")}, "cameras of 0 and 1 are apart is not said: give the distance in metres"),
        ({"frames": ("2", "2"), "distance": 1.0}, "at one place in the result"),
        ({"poses": "poses.txt", "distance": 1.0}, "a distance is one between two frames or two pixels"),
        ({"frames": ("0", "1"), "distance": 1.0, "depth_unit": 0.01}, "a unit of depth is that of a sensor's depth"),
        (
            {"frames": ("0", "9"), "distance": 1.0},
            "no frame '9': give a name such as 'view 0', or a number from 0 to 3",
        ),
        ({"pixels": ("0,1", "0,2,3"), "distance": 1.0}, "no frame|expected a pixel as FRAME,U,V"),
        ({"pixels": ("0,1,x", "0,2,3"), "distance": 1.0}, "expected a pixel as FRAME,U,V, got '0,1,x'"),
        ({"pixels": ("0,1,1", "0,2,900"), "distance": 1.0}, "outside of the image, which has 128 x 96 pixels"),
        ({"pixels": ("0,1,1", "0,1,1"), "distance": 1.0}, "at one place"),
        ({"depth": "."}, "holds no 16-bit grey PNG file whose name begins with that of a frame"),
        ({"depth": "nowhere"}, "nowhere is no folder: expected one of 16-bit PNG files"),
        ({"poses": "nowhere"}, r"nowhere does not exist: expected a COLMAP folder, a transforms\.json"),
        ({}, "give one of them"),
        ({"depth": ".", "poses": "x"}, "give one of them"),
    ],
)
def test_what_tells_no_scale_is_refused(
    result: Reconstruction,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: dict[str, object],
    complaint: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=complaint) as caught:
        rescale(result, tmp_path / "out", progress=False, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


def test_the_command(result: Reconstruction, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["scale", str(result.folder), "--output", str(tmp_path / "out"), "--between-frames", "0", "3"]
    assert main([*arguments, "--distance", "0"]) == 2
    assert "above 0 metres" in capsys.readouterr().err
    assert main([*arguments, "--distance", "2"]) == 0
    assert "2 m in truth" in capsys.readouterr().out
    assert Reconstruction.open(tmp_path / "out").metric
