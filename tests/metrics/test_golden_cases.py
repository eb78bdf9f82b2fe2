"""No stored case of the reference metrics is left out of the tests."""

import json
from pathlib import Path

import pytest

FAMILIES = {
    "depth": ("test_depth.py",),
    "relpose": ("test_pose.py",),
    "trajectory": ("test_trajectory.py",),
    "points": ("test_points.py",),
    "preprocess_io": ("../evaluation/protocols/test_images.py",),
}
# Cases about files on disk belong to the data sets' readers.
OF_READERS = {
    "co3d_rt_to_opencv",
    "sintel_dpt",
    "sintel_cam",
    "bonn_png",
    "kitti_png",
    "nrgbd_poses",
    "seven_scenes_depth_filter",
}
# Alignments and pairings that no benchmark of ours uses: poses paired by time, pointmaps aligned by median scale and
# z-shift, FastVGGT's boxes and voxels.
UNUSED = {"associate", "pointmap_protocol", "bbox_scale_fastvggt", "chamfer_fastvggt"}


@pytest.mark.parametrize("family", FAMILIES)
def test_every_case_has_a_test(family: str, golden_dir: Path) -> None:
    cases = {case["id"] for case in json.loads((golden_dir / "metrics" / f"{family}.json").read_text())["cases"]}
    text = "".join((Path(__file__).parent / name).read_text() for name in FAMILIES[family])
    assert not {case for case in cases - OF_READERS - UNUSED if case not in text}
