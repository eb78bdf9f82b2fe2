"""Interlaced captures of which nothing in the file says so."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from test_video import library, write  # noqa: F401

from logvggt_jax.reconstruction.sources import open_source
from logvggt_jax.reconstruction.sources.alternate_lines import AlternateLines

TEXTURE = cv2.normalize(
    cv2.GaussianBlur(np.random.default_rng(0).uniform(size=(300, 640)), (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX
).astype(np.uint8)


def moments(count: int, down: int, right: int) -> list[np.ndarray]:
    """A picture that moves by so many pixels from one moment to the next."""
    return [
        np.repeat(TEXTURE[down * i : down * i + 96, right * i : right * i + 128, None], 3, axis=2) for i in range(count)
    ]


def of_two(taken: list[np.ndarray], first: str) -> list[np.ndarray]:
    """Pictures of two moments each, of which the even or the odd lines are the earlier."""
    pictures = []
    for early, late in zip(taken[::2], taken[1::2], strict=True):
        picture = late.copy()
        picture[0 if first == "even" else 1 :: 2] = early[0 if first == "even" else 1 :: 2]
        pictures.append(picture)
    return pictures


def judged(pictures: list[np.ndarray]) -> bool:
    lines = AlternateLines()
    for position, picture in enumerate(pictures):
        if lines.wants(position):
            lines.add(position, picture)
    return lines.found()


@pytest.mark.parametrize(("down", "right"), [(0, 1), (0, 3), (1, 2)])
def test_two_moments_are_told_from_one(down: int, right: int) -> None:
    taken = moments(160, down, right)
    assert judged(of_two(taken, "even"))
    assert judged(of_two(taken, "odd"))
    assert not judged(taken) and not judged(taken[::2])
    assert not judged(taken[:1] * 80), "nothing moves"


@pytest.mark.parametrize("size", [2, 8])
@pytest.mark.parametrize(("down", "right"), [(2, 0), (2, 3), (0, 2)])
def test_enlarged_pictures_are_whole(size: int, down: int, right: int) -> None:
    """Their edges lie between the same lines, as those of games and of screens do."""
    blocks = np.random.default_rng(1).integers(0, 256, (400 // size, 640 // size), np.uint8)
    enlarged = np.repeat(np.repeat(blocks, size, axis=0), size, axis=1)[..., None].repeat(3, axis=2)
    assert not judged([enlarged[down * i : down * i + 96, right * i : right * i + 128] for i in range(80)])


def test_films_that_became_television_are_told() -> None:
    """Of four pictures of a film, television makes ten fields: two of five pictures show two of them."""
    films = [np.roll(TEXTURE[:96, :256], 3 * i, axis=1)[..., None].repeat(3, axis=2) for i in range(400)]
    fields = [film for i, film in enumerate(films) for _ in range(2 + i % 2)]
    assert judged(of_two(fields[: len(fields) // 2 * 2], "even"))


@pytest.mark.parametrize("first", ["even", "odd"])
def test_a_capture_that_does_not_say_so_is_noted(tmp_path: Path, library: str, first: str) -> None:  # noqa: F811
    taken = moments(160, 0, 2)
    for name, pictures, noted in (("tv", of_two(taken, first), True), ("film", taken[::2], False)):
        path = tmp_path / f"{name}.avi"
        write(path, pictures, codec="mjpeg", pixels="yuvj420p", rate=25, options={"qmax": "3", "b": "20M"})
        source = open_source(path, stride=7)
        assert len(list(source)) == 12
        assert any("tv.avi looks interlaced, though nothing in it says so" in note for note in source.notes) == noted


def test_a_walk_of_whole_pictures_is_not_noted(seven_scenes_dir: Path) -> None:
    lines = AlternateLines()
    for position, path in enumerate(sorted((seven_scenes_dir / "redkitchen" / "seq-01").glob("*.color.jpg"))):
        if lines.wants(position):
            lines.add(position, cv2.imread(str(path)))
    assert not lines.found()
