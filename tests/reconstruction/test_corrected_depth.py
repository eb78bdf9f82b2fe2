"""Results whose depth gets a factor a frame when the sequence has ended, as loops give it: all files agree."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from recorder import Recorder, reconstruct_recorded

from logvggt_jax.geometry import unproject
from logvggt_jax.reconstruction import PointFilter, Reconstruction, rescale
from logvggt_jax.reconstruction.exporters.ply import export_ply
from logvggt_jax.reconstruction.points.cloud_file import read_points
from logvggt_jax.streaming import Cameras

COUNT = 5
SCALE = np.array([1.0, 0.5, 2.0, 1.25, 0.3], np.float32)


class Looped(Recorder):
    """The recorder's depth, whose cameras come with factors and a loop."""

    def cameras(self) -> Cameras:
        return (
            super().cameras()._replace(depth_scale=SCALE[: self.num_frames], loops=np.array([[0, self.num_frames - 1]]))
        )


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("walk")
    pictures = np.random.default_rng(0).integers(0, 256, (COUNT, 28, 42, 3), np.uint8)
    for index, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"{index}.png")
    return folder


def run(predictor: Recorder, walk: Path, output: Path, point_filter: PointFilter) -> Reconstruction:
    return reconstruct_recorded(predictor, walk, output, point_filter=point_filter, progress=False, save_seconds=0.0)


# Every point from the files, all from the samples taken at first sight, and some of either.
@pytest.mark.parametrize("most", [None, 100, 3000])
def test_depth_cameras_and_points_agree(walk: Path, tmp_path: Path, most: int | None) -> None:
    chosen = PointFilter(confidence_percentile=0.0, max_points=most)
    plain = run(Recorder(), walk, tmp_path / "plain", chosen)
    result = run(Looped(), walk, tmp_path / "looped", chosen)
    np.testing.assert_array_equal(result.depth_scale, SCALE.astype(np.float64))
    for index in range(COUNT):
        np.testing.assert_allclose(result.depth(index), SCALE[index] * plain.depth(index), rtol=1e-6)
        np.testing.assert_array_equal(result.confidence(index), plain.confidence(index))
    points, colours = result.points()
    np.testing.assert_array_equal(colours, plain.points()[1], err_msg="the same pixels")
    clouds = [unproject(result.depth(i), result.depth_intrinsics[i], result.extrinsics[i]) for i in range(COUNT)]
    known = {np.round(point, 4).tobytes() for cloud in clouds for point in cloud.reshape(-1, 3).astype(np.float32)}
    assert sum(np.round(point, 4).tobytes() in known for point in points) > 0.99 * len(points)
    export_ply(Reconstruction.open(result.folder), tmp_path / "again.ply", point_filter=chosen, progress=False)
    np.testing.assert_array_equal(read_points(tmp_path / "again.ply")[0], points)


def test_the_files_say_so_and_others_stay_as_they_were(walk: Path, tmp_path: Path) -> None:
    plain = run(Recorder(), walk, tmp_path / "plain", PointFilter())
    result = run(Looped(), walk, tmp_path / "looped", PointFilter())
    document, before = (json.loads((each.folder / "cameras.json").read_text()) for each in (result, plain))
    assert [frame["depth_scale"] for frame in document["frames"]] == SCALE.tolist()
    assert document["loops"] == [[0, COUNT - 1]] and "depth_scale" in document["conventions"]
    assert "loops" not in before and "depth_scale" not in json.dumps(before)
    assert "loops closed: 1 (0 with 4)" in result.summary() and "times depth_scale of cameras.json" in result.summary()
    assert "loop" not in plain.summary() and "depth_scale" not in plain.summary()
    assert result.loops == ((0, COUNT - 1),) and plain.loops is None
    # A result that is made from it knows of them, too.
    made, _ = rescale(result, tmp_path / "metres", frames=("0", "1"), distance=1.0, progress=False)
    assert made.loops == result.loops
    for name in (f"depth/{index}.npz" for index in range(COUNT)):
        assert (result.folder / name).read_bytes() == (plain.folder / name).read_bytes(), "depth is written once"


def test_a_run_that_died_gives_the_same_bytes(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("logvggt_jax.reconstruction.run._SAVING", 1e9)
    straight = run(Looped(), walk, tmp_path / "straight", PointFilter(max_points=300))

    def die(count: int) -> None:
        if count == 4:
            raise KeyboardInterrupt

    def once_more(on_push: Callable[[int], object] = lambda _: None) -> Reconstruction:
        return run(Looped(on_push), walk, tmp_path / "out", PointFilter(max_points=300))

    with pytest.raises(KeyboardInterrupt):
        once_more(die)
    result = once_more()
    for name in ("cameras.json", "points.ply", "trajectory.txt"):
        assert (result.folder / name).read_bytes() == (straight.folder / name).read_bytes(), name
