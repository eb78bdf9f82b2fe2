"""Pictures of results: they show what they claim, read back from the file."""

from pathlib import Path

import cv2
import numpy as np

from logvggt_jax.evaluation.report.figures import (
    curves_plot,
    depth_panel,
    efficiency_plot,
    point_clouds,
    trajectory_plot,
)


def poses(count: int) -> np.ndarray:
    result = np.tile(np.eye(4), (count, 1, 1))
    angle = np.linspace(0, 4, count)
    result[:, :3, 3] = np.stack([np.cos(angle), 0.1 * angle, np.sin(angle)], axis=-1)
    return result


def orange_pixels(path: Path) -> int:
    picture = cv2.imread(str(path)).astype(int)
    blue, green, red = picture[..., 0], picture[..., 1], picture[..., 2]
    return int(((red > 200) & (green > 90) & (green < 180) & (blue < 90)).sum())


def test_a_trajectory_is_drawn_beside_the_truth(tmp_path: Path) -> None:
    wrong = poses(20)
    wrong[:, :3, 3] += np.random.default_rng(0).normal(0, 0.2, (20, 3))
    trajectory_plot(tmp_path / "new" / "wrong.png", wrong[:, :3], poses(20))
    assert orange_pixels(tmp_path / "new" / "wrong.png") > 500
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["wrong.png"]


def test_a_prediction_that_stands_still_is_left_out(tmp_path: Path) -> None:
    trajectory_plot(tmp_path / "static.png", np.tile(np.eye(4), (20, 1, 1)), poses(20))
    assert orange_pixels(tmp_path / "static.png") == 0


def test_a_panel_shows_every_frame_and_only_real_errors(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (5, 28, 42, 3), np.uint8)
    target = rng.uniform(1, 3, (5, 28, 42)).astype(np.float32)
    target[0, :10] = 0.0
    depth_panel(tmp_path / "right.png", images, target, 0.5 * target, max_frames=2)
    depth_panel(tmp_path / "wrong.png", images, target, rng.uniform(1, 3, target.shape), max_frames=2)
    right, wrong = (cv2.imread(str(tmp_path / f"{name}.png")) for name in ("right", "wrong"))
    assert right.shape == wrong.shape
    # The error is the last column of pictures: black where the depth is right up to its unit.
    last = slice(int(0.76 * right.shape[1]), int(0.9 * right.shape[1]))
    assert (right[:, last].max(-1) < 20).mean() > (wrong[:, last].max(-1) < 20).mean() + 0.3


def test_a_clip_without_valid_depth_can_be_drawn(tmp_path: Path) -> None:
    nothing = np.zeros((1, 14, 28), np.float32)
    depth_panel(tmp_path / "none.png", np.zeros((1, 14, 28, 3), np.uint8), nothing, nothing + 1)
    assert (tmp_path / "none.png").stat().st_size > 1000


def test_efficiency_shows_rates_and_parts(tmp_path: Path) -> None:
    """Bars of a part are as tall as its share: twice the seconds, about twice the pixels of its colour."""
    speed = [
        {"mode": mode, "frames": n, "frames_per_second": [8.0, 9.0, 10.0]} for mode in ("a", "b") for n in (10, 20)
    ]

    def brown_pixels(name: str, seconds: float) -> int:
        rows = [{"name": str(i), "seconds": 0.0} for i in range(5)] + [{"name": "last", "seconds": seconds}]
        rows[0]["seconds"] = 4.0 - seconds
        efficiency_plot(tmp_path / name, {"device": "d", "speed": speed, "part_frames": 20, "parts": {"a": rows}})
        blue, green, red = np.moveaxis(cv2.imread(str(tmp_path / name)).astype(int), -1, 0)
        return int(((abs(red - 140) < 8) & (abs(green - 86) < 8) & (abs(blue - 75) < 8)).sum())

    one, two = brown_pixels("one.png", 1.0), brown_pixels("two.png", 2.0)
    assert one > 5000 and 1.8 < two / one < 2.2


def test_both_clouds_are_drawn_in_their_colours_and_the_nearest_points_in_front(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    wall = np.concatenate([rng.uniform(-1, 1, (60_000, 2)), np.full((60_000, 1), 3.0)], axis=1)
    orange = np.tile(np.array([[230, 130, 40]], np.uint8), (len(wall), 1))
    point_clouds(tmp_path / "one.png", wall, wall, orange, np.eye(4))
    assert orange_pixels(tmp_path / "one.png") > 20_000
    # A black wall before it hides it; it is the nearer one, though it comes first in the list.
    near = wall - [0.0, 0.0, 1.0]
    both, colours = np.concatenate([near, wall]), np.concatenate([np.zeros_like(orange), orange])
    point_clouds(tmp_path / "two.png", both, both, colours, np.eye(4))
    assert orange_pixels(tmp_path / "two.png") < 0.9 * orange_pixels(tmp_path / "one.png")


def test_ate_is_drawn_for_every_method(tmp_path: Path) -> None:
    curves = {"a": [(50, 0.1), (100, 0.2)], "b": [(50, 0.3), (100, 0.1)]}
    curves_plot(tmp_path / "ate.png", curves, "ATE", x_label="views", y_label="ATE (m)")
    assert orange_pixels(tmp_path / "ate.png") > 200


def test_depth_of_another_size_is_resized_to_the_truth(tmp_path: Path) -> None:
    target = np.full((2, 28, 42), 2.0, np.float32)
    depth_panel(tmp_path / "panel.png", np.zeros((2, 14, 28, 3), np.uint8), target, np.ones((2, 14, 28), np.float32))
    picture = cv2.imread(str(tmp_path / "panel.png"))
    last = slice(int(0.76 * picture.shape[1]), int(0.9 * picture.shape[1]))
    assert (picture[:, last].max(-1) < 20).mean() > 0.3
