"""What decodes and is wrong all the same is reported, by file and with its mend; what is right is not."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layouts.layout import VIEWS, Layout
from layouts.tum_recording import CALIBRATION
from readers.test_contract import NAMES, layout_of
from room_views import RoomView, millimetres, write_image

from logvggt_jax.data.checks.check import check_copy
from logvggt_jax.data.registry import READERS

SIZE = VIEWS[0].depth.shape


def problems(layout: Layout, root: Path, views: list[RoomView] | None = None) -> list[tuple[str, str]]:
    layout.write(root, views or layout.views)
    report = check_copy(layout.reader.name, root, all_images=True)
    return [(problem.kind, problem.message) for problem in report.problems]


@pytest.mark.parametrize("name", NAMES)
def test_sound_copies_of_every_set_are_clean(name: str, tmp_path: Path):
    assert problems(layout_of(name), tmp_path) == []


def noisy(level: float, spread: float) -> np.ndarray:
    noise = np.random.default_rng(0).normal(level, spread, (*SIZE, 3))
    return np.clip(np.rint(noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", ["co3dv2", "scannet", "virtual_kitti"])
@pytest.mark.parametrize(
    ("picture", "seen"),
    [
        (np.zeros((*SIZE, 3), np.uint8), "black throughout"),
        (noisy(5, 2), "black throughout"),
        (np.full((*SIZE, 3), (200, 10, 90), np.uint8), r"one colour \(red \d+, green 1\d, blue \d+\) throughout"),
        (noisy(120, 0.5), "one colour"),
    ],
)
def test_blank_pictures_are_named(name: str, tmp_path: Path, picture: np.ndarray, seen: str):
    layout = layout_of(name)
    views = [layout.views[0], replace(layout.views[1], picture=picture), *layout.views[2:]]
    ((kind, message),) = problems(layout, tmp_path, views)
    assert kind == "blank picture" and message.startswith(f"{tmp_path / layout.image}: ")
    assert re.search(seen, message) and "fetch it again" in message


def test_dark_and_pale_pictures_with_content_are_not_blank(tmp_path: Path):
    layout = layout_of("scannet")
    dark, pale = (VIEWS[1].picture // 6, 200 + VIEWS[1].picture // 8)
    views = [VIEWS[0], replace(VIEWS[1], picture=dark), replace(VIEWS[2], picture=pale), VIEWS[3]]
    assert problems(layout, tmp_path, views) == []


def test_depth_that_is_too_near_is_named_for_every_frame(tmp_path: Path):
    layout = layout_of("sintel")
    views = [replace(each, depth=each.depth * 1e-3) for each in layout.views]
    found = [message for kind, message in problems(layout, tmp_path, views) if kind == "implausible depth"]
    assert len(found) == 4 and all("0.01 to 1000 expected" in message for message in found)
    assert found[1].startswith(f"{tmp_path / layout.depth}: the median of its depth is ")


def test_metres_in_a_file_of_millimetres_are_named(tmp_path: Path):
    layout = layout_of("scannet")
    layout.write(tmp_path, layout.views)
    path = tmp_path / layout.depth
    write_image(path, np.rint(VIEWS[1].depth).astype(np.uint16))
    report = check_copy("scannet", tmp_path, all_images=True)
    problem = next(each for each in report.problems if each.kind == "implausible depth")
    assert problem.message.startswith(f"{path}: the median of its depth is 0.00") and "0.05 to 50 expected" in (
        problem.message
    )


def test_millimetres_taken_for_metres_are_named(tmp_path: Path):
    """A recording whose calibration says 1 unit a metre and whose depth is in millimetres."""
    layout = layout_of("tum_recording")
    layout.write(tmp_path, layout.views)
    (tmp_path / "desk/calibration.txt").write_text(f"{CALIBRATION}depth_scale 1\n")
    for path, each in zip(sorted((tmp_path / "desk/depth").iterdir()), layout.views, strict=True):
        write_image(path, millimetres(each.depth))
    report = check_copy("tum_recording", tmp_path)
    assert len(report.problems) == 5
    assert all("desk/depth/" in each.message and "depth_scale=1 in" in each.message for each in report.problems)


def test_sets_without_metres_have_any_depth(tmp_path: Path):
    layout = layout_of("blendedmvs")
    pose = [each.pose.copy() for each in layout.views]
    for each in pose:
        each[:3, 3] *= 1e4
    views = [replace(each, depth=each.depth * 1e4, pose=p) for each, p in zip(layout.views, pose, strict=True)]
    assert problems(layout, tmp_path, views) == []


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_calibration_of_pictures_of_another_size_is_named(tmp_path: Path, factor: float):
    layout = layout_of("kitti")
    layout.write(tmp_path, layout.views)
    path = tmp_path / layout.tables[0]
    line = next(each for each in path.read_text().splitlines() if each.startswith("P_rect_02"))
    values = [float(word) for word in line.split()[1:]]
    values[:8] = [factor * value for value in values[:8]]
    path.write_text(f"P_rect_02: {' '.join(map(str, values))}\n")
    report = check_copy("kitti", tmp_path)
    assert set(report.problem_counts()) == {"calibration of another size"}
    assert report.problems[0].message.startswith(f"{path}: the principal point")


def test_shifted_lenses_of_hypersim_are_no_other_size():
    assert not READERS["hypersim"].centred and READERS["kitti"].centred
