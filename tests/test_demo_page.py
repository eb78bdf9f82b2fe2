"""The page of `make demo`: one file with every picture in it, numbers that are right; what is missing is named."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import demo_page
import numpy as np
import pytest

from logvggt_jax.errors import InputError
from logvggt_jax.geometry import relative_to_first
from logvggt_jax.reconstruction.reconstruct import Reconstruction
from logvggt_jax.reconstruction.room_sequence import read_room_sequence, write_room_sequence

COUNT, SIZE = 12, (28, 42)


class Scaled:
    """A reconstruction of a room that is right up to its unit."""

    def __init__(self, room: Path) -> None:
        truth = read_room_sequence(room)
        self.folder, self.num_frames, self.depth_size = Path("result"), COUNT, SIZE
        self.extrinsics = np.asarray(relative_to_first(truth.extrinsics.astype(np.float64)))[:, :3].copy()
        self.extrinsics[:, :, 3] *= 0.4
        self.depth_intrinsics, self._depth = truth.intrinsics, 0.4 * truth.depth

    def depth_and_confidence(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        return self._depth[index], np.ones(SIZE, np.float32)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the demo's commands leave, but for the reconstruction."""
    folder = tmp_path_factory.mktemp("demo")
    write_room_sequence(folder / "room", num_frames=COUNT, image_size=SIZE, progress=False)
    (folder / "evaluation").mkdir()
    results: dict[str, Any] = {"methods": [], "summary": [], "benchmarks": []}
    (folder / "evaluation" / "results.json").write_text(json.dumps(results))
    (folder / "training").mkdir()
    lines = [
        {"step": 1, "train/abs_rel": 0.4},
        {"step": 200, "train/abs_rel": 0.11},
        {"step": 200, "validation/abs_rel": 0.125, "validation/constant_abs_rel": 0.2},
    ]
    (folder / "training" / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


@pytest.fixture
def demo(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = shutil.copytree(made, tmp_path / "demo")
    monkeypatch.setattr(Reconstruction, "open", lambda _: Scaled(folder / "room"))
    return folder


@pytest.fixture(scope="module")
def written(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with its page."""
    folder = shutil.copytree(made, tmp_path_factory.mktemp("written") / "demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Reconstruction, "open", lambda _: Scaled(folder / "room"))
        assert demo_page.write_page(folder) == folder / "index.html"
    return folder


def test_the_page_holds_pictures_numbers_and_the_viewers_command(written: Path) -> None:
    text = (written / "index.html").read_text()
    assert len(re.findall(r'<img [^>]*src="data:image/png;base64,', text)) == 5 and 'src="http' not in text
    assert text.index("<img") < text.index("<table"), "pictures first"
    row = re.search(r"<td>LoG-VGGT</td>(.*?)</tr>", text)
    assert row is not None
    abs_rel, delta, rotation, rra, rta, auc, ate, ratio = re.findall(r"<td>(.*?)</td>", row[1])
    assert (abs_rel, delta, rotation, rra, rta) == ("0.000", "1.000", "0.000", "1.000", "1.000")
    assert (ate, ratio) == ("0.000", "0.000") and float(auc) > 0.95
    assert "went from 0.400 at step 1 to 0.110 at step 200; on rooms that are not trained on to 0.125, where" in text
    assert text.rindex("logvggt view result") > text.rindex("<img"), "at the end"


def test_both_views_look_into_the_room(written: Path) -> None:
    """Prediction and truth, side by side, are the same picture where the reconstruction is right."""
    for number in (1, 2):
        picture = cv2.imread(str(written / "figures" / f"points-{number}.png"))
        drawn = picture[60:].min(-1) < 200  # below the titles
        left, right = (half.sum() for half in np.array_split(drawn, 2, axis=1))
        assert left > 500 and abs(left - right) < 0.1 * left


def test_a_camera_that_stands_still_and_a_training_that_only_compiled_make_a_page(
    demo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = Scaled(demo / "room")
    still.extrinsics[:] = np.eye(4)[:3]
    monkeypatch.setattr(Reconstruction, "open", lambda _: still)
    (demo / "training" / "metrics.jsonl").write_text(json.dumps({"step": 1, "train/abs_rel": 0.4}) + "\n")
    text = demo_page.write_page(demo).read_text()
    assert "The path could not be laid over the truth" in text and "<td>-</td>" in text
    assert "from 0.400 at step 1 to 0.400 at step 1. Camera" in text


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        ("room", "give the output of `logvggt render-room`"),
        ("evaluation/results.json", "results.json: No such file"),
        ("training/metrics.jsonl", "metrics.jsonl: No such file"),
    ],
)
def test_a_part_that_is_missing_is_named(demo: Path, missing: str, message: str) -> None:
    result = Scaled(demo / "room")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Reconstruction, "open", lambda _: result)
        shutil.rmtree(demo / missing) if missing == "room" else (demo / missing).unlink()
        with pytest.raises(InputError, match=message):
            demo_page.write_page(demo)
    assert not (demo / "index.html").exists()
