"""Every fault put into the footage is named where it is, and a walk without one gets none; numbers survive a resume."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from html.parser import HTMLParser
from pathlib import Path

import cv2
import faulty_rooms as rooms
import numpy as np
import pytest
from PIL import Image
from recorder import reconstruct_recorded
from result_folder import write_result

from logvggt_jax import load_model
from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames
from logvggt_jax.reconstruction import Reconstruction, reconstruct
from logvggt_jax.reconstruction.health import report
from logvggt_jax.reconstruction.health.looks import NUMBERS
from logvggt_jax.reconstruction.health.measures import Measures
from logvggt_jax.reconstruction.health.pictures import compare_pictures
from logvggt_jax.reconstruction.health.plot import svg_plot
from logvggt_jax.reconstruction.health.recorder import HealthRecorder
from logvggt_jax.reconstruction.health.rules import Stretch, stretches
from logvggt_jax.reconstruction.health.words import in_short, paragraph, reasons
from logvggt_jax.streaming import Signals

# Frames by which a stretch may begin or end beside the fault: zoom and movement are seen over a few frames.
AROUND = 4


def measured(frames: Frames, signals: Signals) -> Measures:
    count, recorder = len(frames.images), HealthRecorder()
    for index in reversed(range(count)):  # the order is that of the worker threads
        recorder.see(index, frames.depth[index], np.full(rooms.SIZE, 5.0, np.float32), frames.images[index])
    return recorder.measures(
        size=rooms.SIZE,
        extrinsics=frames.extrinsics[:, :3],
        intrinsics=frames.intrinsics,
        depth_scale=np.ones(count),
        field_of_view=2 * np.arctan(rooms.SIZE[1] / 2 / frames.intrinsics[:, 0, 0]),
        signals=signals,
    )


@pytest.mark.parametrize("cause", rooms.FAULTY)
def test_every_fault_is_named_where_it_is(cause: str) -> None:
    make, where = rooms.FAULTY[cause]
    measures = measured(make(), rooms.signals(rooms.COUNT, where))
    found = stretches(measures)
    assert {stretch.cause for stretch in found} == {cause}
    assert len(found) == (2 if cause == "exposure" else 1)
    assert abs(found[0].first - where[0]) <= AROUND and abs(found[-1].last - where[-1]) <= AROUND
    assert all({"overlap_change", "correction"} <= set(stretch.signs) for stretch in found)
    text = paragraph(found, measures, [f"{index}.png" for index in range(rooms.COUNT)])
    assert "most likely" in text and f"({found[0].first}.png" in text
    assert f"{cause} (" in in_short(found, rooms.COUNT)


@pytest.mark.parametrize("number", [1, 3, 4])
def test_a_walk_without_fault_has_no_doubtful_frame(number: int) -> None:
    measures = measured(rooms.clean(number), rooms.signals(rooms.COUNT, ()))
    assert stretches(measures) == ()
    assert "None of the 40 frames is doubtful" in (text := paragraph((), measures, [])) and "Most rules" not in text
    assert "Most rules need 8 frames or more, and say nothing here" in paragraph((), Measures.of({}, 3), [])


def test_a_cut_is_seen_though_the_predicted_cameras_do_not_tell() -> None:
    frames, signals = rooms.clean(), rooms.signals(rooms.COUNT, (20,))
    images = np.concatenate([frames.images[:20], rooms.clean(3).images[20:]])
    (found,) = stretches(measured(frames._replace(images=images), signals))
    assert (found.cause, found.first, found.last) == ("no overlap", 20, 20)


@pytest.mark.parametrize("other_room", [False, True])
def test_where_cameras_say_fast_the_pictures_tell_whether_it_may_be_a_cut(other_room: bool) -> None:
    """One step is long. Predicted cameras say so of a cut as well, but then what both frames would see is not alike."""
    frames = rooms.walk([*range(20), *range(35, 55)], number=1)
    after = rooms.walk(range(20), number=6).images if other_room else frames.images[20:]
    images = np.concatenate([frames.images[:20], after])
    measures = measured(frames._replace(images=images), rooms.signals(rooms.COUNT, ()))
    assert np.nanmin(np.delete(measures.likeness, 20)) > 0.9 and (measures.likeness[20] < 0.75) == other_room
    (found,) = stretches(measures)
    assert (found.cause, found.first, found.last) == ("fast or cut" if other_room else "fast", 20, 20)
    assert ("or the footage is cut" in paragraph((found,), measures, ["x"] * rooms.COUNT)) == other_room


def test_what_moves_is_not_looked_for_across_a_jump() -> None:
    measures = measured(rooms.jump(), rooms.signals(rooms.COUNT, ()))
    measures.conflicts[rooms.FAULT.start : rooms.FAULT.start + 4] = 0.5
    assert [stretch.cause for stretch in stretches(measures)] == ["no overlap"]


@pytest.mark.parametrize("make", [rooms.dark, rooms.overexposed])
def test_cameras_of_pictures_that_show_nothing_are_not_believed(make: Callable[[], Frames]) -> None:
    measures = measured(make(), rooms.signals(rooms.COUNT, rooms.FAULT))
    measures.overlap[[rooms.FAULT.start, rooms.FAULT.start + 2, rooms.FAULT.stop]] = 0.1, 0.4, 0.1
    (found,) = stretches(measures)
    assert (found.cause, found.first, found.last) == ("dark" if make is rooms.dark else "bright", 16, 23)


@pytest.mark.parametrize("overlap", [0.4, 0.1])
def test_a_jump_of_the_exposure_is_no_movement_though_depth_suffers_from_it(overlap: float) -> None:
    measures = measured(rooms.flickering(), rooms.signals(rooms.COUNT, rooms.FAULT))
    jumps = [rooms.FAULT.start, rooms.FAULT.stop]
    measures.overlap[jumps], measures.conflicts[jumps] = overlap, 0.3
    found = stretches(measures)
    assert {stretch.cause for stretch in found} == {"exposure"} and [stretch.first for stretch in found] == jumps


def test_a_jump_of_the_exposure_is_told_with_the_brightness_before_and_after() -> None:
    measures = measured(rooms.flickering(), rooms.signals(rooms.COUNT, rooms.FAULT))
    text = paragraph(stretches(measures), measures, ["x"] * rooms.COUNT)
    for frame in (rooms.FAULT.start, rooms.FAULT.stop):
        low, high = sorted(measures.brightness[[frame - 1, frame]])
        assert f"brightness jumps between {low:.0%} and {high:.0%} of white" in text


def with_floating_depth(frames: Sequence[int]) -> Frames:
    """A still room, and depth with a large surface that floats in front of it in some frames."""
    still = rooms.clean()
    depth, random = np.array(still.depth), np.random.default_rng(0)
    height, width = rooms.SIZE
    for index in frames:
        top, left = random.integers(height // 2), random.integers(width - height // 2)
        depth[index, top : top + height // 2, left : left + height // 2] *= 0.4
    return still._replace(depth=depth)


def test_depth_that_is_wrong_for_a_while_is_not_called_movement() -> None:
    """It hides what should be seen, as what moves does, but the pictures stay as they are."""
    measures = measured(with_floating_depth(range(20, 25)), rooms.signals(rooms.COUNT, ()))
    assert np.nanmax(measures.conflicts) > 0.04 > 0.6 * np.nanmax(measures.elsewhere)
    (found,) = stretches(measures)
    assert (found.cause, found.first) == (None, 20) and "conflicts" in found.signs
    text = paragraph((found,), measures, ["x"] * rooms.COUNT)
    assert "moves" not in text and "nothing that is measured of the footage says why" in text
    moving = measured(rooms.moving_subject(standing=False), rooms.signals(rooms.COUNT, ()))
    until = rooms.FAULT.stop + 4  # when the frame of the comparison is without it again
    assert np.nanmax(moving.elsewhere[rooms.FAULT.start : until]) > 0.06
    assert np.nanmax(np.delete(moving.elsewhere, range(rooms.FAULT.start, until))) < 0.06


@pytest.mark.parametrize(
    ("make", "first", "changed"), [(rooms.dark, 12, 16), (rooms.blurred, 12, 16), (rooms.hurried, 24, 24)]
)
def test_pictures_that_change_for_another_reason_are_no_movement(
    make: Callable[[], Frames], first: int, changed: int
) -> None:
    measures = measured(make(), rooms.signals(rooms.COUNT, rooms.FAULT))
    measures.conflicts[first : first + 3] = 0.3
    measures.elsewhere[changed : changed + 4] = 0.2
    assert "moving" not in {stretch.cause for stretch in stretches(measures)}


@pytest.mark.parametrize("degrees", [25, 60])
def test_cameras_that_turn_where_the_picture_stays_are_not_called_fast(degrees: int) -> None:
    frames = rooms.clean()
    extrinsics = np.array(frames.extrinsics)
    extrinsics[20:] = rotation_y(degrees) @ extrinsics[20:]
    measures = measured(frames._replace(extrinsics=extrinsics), rooms.signals(rooms.COUNT, ()))
    assert measures.overlap[20] < 0.7 and measures.shared_picture[20] > 0.9
    found = stretches(measures)
    assert {stretch.cause for stretch in found} == {None}
    assert any("cameras" in stretch.signs and stretch.first <= 20 <= stretch.last for stretch in found)
    assert "cameras turn away from what the pictures still show" in paragraph(found, measures, ["x"] * rooms.COUNT)


def rotation_y(degrees: float) -> np.ndarray:
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turned = np.eye(4)
    turned[:3, :3] = [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]
    return turned


def test_detail_that_goes_little_by_little_may_be_that_of_a_smooth_surface() -> None:
    measures = measured(rooms.clean(), rooms.signals(rooms.COUNT, ()))
    fading = 0.75 ** np.concatenate([np.arange(1, 11), np.arange(10, 0, -1)])
    measures.sharpness[10:30] *= fading
    measures.detail[10:30] *= fading
    (found,) = stretches(measures)
    assert found.cause == "soft"
    assert "most likely the picture is blurred, or shows smooth surfaces" in paragraph(
        (found,), measures, ["x"] * rooms.COUNT
    )


def test_an_edge_that_leaves_the_view_is_no_blur() -> None:
    """Nearly all fine detail of a picture may be in one edge."""
    noise = np.random.default_rng(0).integers(0, 9, (*rooms.SIZE, 1), np.uint8)
    wall = np.full((*rooms.SIZE, 3), 200, np.uint8) + noise
    edge = wall.copy()
    edge[:, -20:] = 20
    sharp, soft = (HealthRecorder() for _ in range(2))
    for recorder, second in ((sharp, wall), (soft, cv2.GaussianBlur(edge, (0, 0), 2))):
        recorder.see(0, np.ones(rooms.SIZE), np.full(rooms.SIZE, 5.0), edge)
        recorder.see(1, np.ones(rooms.SIZE), np.full(rooms.SIZE, 5.0), second)
    numbers = [dict(zip(NUMBERS, recorder.arrays()["numbers"].T, strict=True)) for recorder in (sharp, soft)]
    for each in numbers:
        assert each["sharpness"][1] < each["sharpness"][0] / 4
    leaves, blurs = (each["detail"][0] / each["detail"][1] for each in numbers)
    assert 0.5 < leaves < 2 < blurs


def test_a_lens_is_not_said_to_zoom_by_pictures_that_show_nothing() -> None:
    measures = measured(rooms.dark(), rooms.signals(rooms.COUNT, rooms.FAULT))
    measures.field_of_view[list(rooms.FAULT)] *= 1.4
    assert [stretch.cause for stretch in stretches(measures)] == ["dark"]


def test_a_moving_subject_is_told_from_the_cameras_own_movement() -> None:
    walking = measured(rooms.moving_subject(standing=False), rooms.signals(rooms.COUNT, rooms.FAULT))
    assert {stretch.cause for stretch in stretches(walking)} == {"moving"}
    standing = measured(rooms.moving_subject(), rooms.signals(rooms.COUNT, ()))
    said = [paragraph(stretches(each), each, ["x"] * rooms.COUNT) for each in (walking, standing)]
    assert ["the camera stands still" in text for text in said] == [False, True]


def test_a_result_with_errors_everywhere_is_not_called_movement() -> None:
    """Surfaces that float in front of a still scene in every frame."""
    measures = measured(with_floating_depth(range(rooms.COUNT)), rooms.signals(rooms.COUNT, ()))
    assert np.nanmedian(measures.conflicts) > 0.01
    assert "moving" not in {stretch.cause for stretch in stretches(measures)}


def test_what_hides_nearly_all_of_the_view_at_its_height_is_no_movement() -> None:
    measures = measured(rooms.clean(), rooms.signals(rooms.COUNT, range(20, 25)))
    measures.conflicts[20:25] = 0.1, 0.3, 0.9, 0.3, 0.1
    (found,) = stretches(measures)
    assert (found.cause, found.first, found.last) == (None, 20, 24) and "conflicts" in found.signs


def test_trouble_that_the_footage_does_not_explain_is_said_to_be_so() -> None:
    measures = measured(rooms.clean(), rooms.signals(rooms.COUNT, range(30, 33)))
    (found,) = stretches(measures)
    assert found.cause is None and found.first >= 30 and found.last <= 32
    assert "nothing that is measured of the footage says why" in paragraph((found,), measures, ["x"] * rooms.COUNT)


def test_what_nothing_explains_is_told_once() -> None:
    measures, names = measured(rooms.clean(), rooms.signals(rooms.COUNT, ())), [f"{i}.png" for i in range(rooms.COUNT)]
    found = [Stretch(None, 3, 4, ("conflicts",)), Stretch("dark", 6, 6, ()), Stretch(None, 9, 9, ("correction",))]
    text = paragraph(found, measures, names)
    assert text.startswith("4 of 40 frames are doubtful. Frame 6 (6.png): most likely it is too dark")
    assert text.endswith(
        " Frames 3 to 4 (3.png to 4.png), 9 (9.png): the global refinement moved the camera far and points that should "
        "be seen from four frames away are not; nothing that is measured of the footage says why."
    )
    many = [Stretch(None, 4 * index, 4 * index, ("correction",)) for index in range(9)]
    assert "; nothing" in (text := paragraph(many, measures, names)) and "3 shorter stretches are in its list" in text


def test_signs_are_told_as_a_list() -> None:
    told = reasons(Stretch(None, 3, 5, ("correction", "confidence", "chunks")))
    assert "camera far, the model is unsure of its depth and chunks do not fit one another; nothing" in told


def test_chunks_whose_scale_jumps_are_doubtful() -> None:
    signals = Signals.unknown(rooms.COUNT)
    for frame, scale, apart in ((10, 0.9, 0.01), (20, 1.6, 0.02), (30, 1.5, 0.3)):
        signals.chunk_scale[frame], signals.chunk_residual[frame] = scale, apart
    assert [tuple(each) for each in stretches(measured(rooms.clean(), signals))] == [
        (None, 20, 20, ("chunks",)),
        (None, 30, 30, ("chunks",)),
    ]


def test_small_pictures_tell_what_they_share_and_what_has_moved() -> None:
    random = np.random.default_rng(0)
    wide = cv2.resize(random.uniform(30, 150, (10, 16)), (48, 32), interpolation=cv2.INTER_CUBIC).clip(0, 255)
    here, aside, dim = wide[4:22, 4:28], wide[6:24, 12:36], 0.4 * wide[4:22, 4:28]
    ball = np.array(here)
    ball[6:11, 9:13] = 200
    pictures = np.stack([here, aside, dim, ball, random.uniform(0, 255, here.shape), np.full(here.shape, 9)])
    pairs = np.array([0, 0, 0, 0, 0]), np.array([1, 2, 3, 4, 5])
    shared, elsewhere = compare_pictures(pictures.astype(np.uint8), *pairs).T
    np.testing.assert_allclose(shared[[0, 1, 3, 4]], [8 / 9 * 2 / 3, 1, np.nan, np.nan])
    assert np.isnan(elsewhere[0]) and np.isnan(elsewhere[4])  # they share too little, or nothing
    assert elsewhere[1] < 0.01 and elsewhere[2] > 0.06


def test_geometry_of_neighbours_is_exact_for_exact_frames() -> None:
    frames = rooms.clean()
    measures = measured(frames, Signals.unknown(rooms.COUNT))
    assert np.nanmax(measures.disagreement) < 2e-3 and np.nanmax(measures.conflicts) == 0
    assert np.nanmin(measures.overlap) > 0.9 and np.nanmax(measures.overlap) < 1
    assert np.isnan(measures.overlap[0]) and np.isnan(measures.step[0])
    # Of a wrong scale of every other depth map nearly all is told.
    depth = frames.depth * np.where(np.arange(rooms.COUNT) % 2, 1.2, 1.0)[:, None, None].astype(np.float32)
    wrong = measured(frames._replace(depth=depth), Signals.unknown(rooms.COUNT))
    np.testing.assert_allclose(wrong.disagreement[1:], np.log(1.2), atol=0.03)


@pytest.fixture(scope="module")
def dark_walk(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Frames]:
    folder, frames = tmp_path_factory.mktemp("dark"), rooms.dark()
    for index, picture in enumerate(frames.images):
        Image.fromarray(picture).save(folder / f"{index:03d}.png")
    return folder, frames


Reconstruct = Callable[..., Reconstruction]


@pytest.fixture
def reconstruct_dark(dark_walk: tuple[Path, Frames], monkeypatch: pytest.MonkeyPatch) -> Reconstruct:
    """Reconstructs the walk by the truth; a state is saved after every frame."""
    monkeypatch.setattr("logvggt_jax.reconstruction.run._SAVING", 1e9)
    folder, frames = dark_walk

    def run(output: Path, on_push: Callable[[int], object] = lambda _: None, **options: object) -> Reconstruction:
        truth = rooms.Truth(frames, rooms.signals(rooms.COUNT, rooms.FAULT), on_push)
        options = {"longer_edge": max(rooms.SIZE), "progress": False, "num_previews": 0, **options}
        return reconstruct_recorded(truth, folder, output, **options)

    return run


class Words(HTMLParser):
    """The text of a page, and how many plots it has."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text, self.plots = "", 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.plots += tag == "svg"

    def handle_data(self, data: str) -> None:
        self.text += data


def test_every_result_says_how_it_is(tmp_path: Path, reconstruct_dark: Reconstruct) -> None:
    result = Reconstruction.open(reconstruct_dark(tmp_path / "out").folder)
    health = result.health
    assert health is not None and [each.cause for each in health.stretches] == ["dark"]
    assert np.flatnonzero(health.doubtful).tolist() == list(rooms.FAULT)
    np.testing.assert_allclose(health.measures.overlap_change[1:], rooms.signals(rooms.COUNT, rooms.FAULT)[0][1:], 1e-5)
    summary = result.summary()
    assert "health: 8 of 40 frames doubtful: dark (16 to 23)" in summary
    assert f"{result.folder}/health.html: " in summary
    assert '<meta name="viewport"' in (result.folder / "health.html").read_text()  # else it is tiny on a phone
    page = Words((result.folder / "health.html").read_text())
    assert health.text in page.text and "it is too dark" in page.text and page.plots == 19


def test_a_run_that_died_says_the_same_in_the_end(tmp_path: Path, reconstruct_dark: Reconstruct) -> None:
    def die(count: int) -> None:
        if count == 21:
            raise KeyboardInterrupt

    expected = reconstruct_dark(tmp_path / "straight").folder
    with pytest.raises(KeyboardInterrupt):
        reconstruct_dark(tmp_path / "out", die, save_seconds=0.0)
    found = reconstruct_dark(tmp_path / "out").folder
    for name in ("health.json", "health.html"):
        assert (found / name).read_bytes() == (expected / name).read_bytes()


@pytest.mark.parametrize("broken", ["health.recorder.look", "health.recorder.picture_changes", "health.report._page"])
def test_a_report_that_fails_leaves_the_result_whole(
    broken: str, tmp_path: Path, reconstruct_dark: Reconstruct, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ArithmeticError("what nobody thought of")

    monkeypatch.setattr(f"logvggt_jax.reconstruction.{broken}", fail)
    with pytest.warns(UserWarning, match="no health report: ArithmeticError"):
        folder = reconstruct_dark(tmp_path / "out").folder
    result = Reconstruction.open(folder)
    assert result.num_frames == rooms.COUNT and result.num_points > 0
    assert not (folder / "health.html").exists() or result.health is not None


def test_results_without_a_report_open_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    write_result(tmp_path)
    result = Reconstruction.open(tmp_path)
    assert result.health is None and "health" not in result.summary()
    unknown = Measures.of({}, 3)
    report.write_health(tmp_path, report.examine(unknown, result.names), result.names)
    assert result.health is not None and not result.health.doubtful.any()
    sound = json.loads((tmp_path / "health.json").read_text())
    for later in ("detail", "likeness", "shared_picture", "elsewhere"):  # as the first reports are
        del sound["measures"][later]
    (tmp_path / "health.json").write_text(json.dumps(sound))
    assert result.health is not None and np.isnan(result.health.measures.likeness).all()
    for change in (
        {"format": "other"},
        {"measures": {}},
        {"names": ["0"]},
        {"text": 7},
        {"stretches": [{"cause": "ghosts", "first": 0, "last": 1, "signs": []}]},
        {"stretches": [{"cause": "dark", "first": 0, "last": 3, "signs": []}]},
    ):
        (tmp_path / "health.json").write_text(json.dumps({**sound, **change}))
        with pytest.raises(InputError, match=r"health\.json is not a health report"):
            _ = Reconstruction.open(tmp_path).health
        assert "health.json is not a health report" in Reconstruction.open(tmp_path).summary()


def test_a_plot_of_a_long_sequence_stays_small_and_keeps_its_peaks() -> None:
    values = np.sin(np.arange(50_000) / 500)
    values[31_234], values[1000:2000] = 9.0, np.nan
    plot = svg_plot(values, [(31_000, 31_500)], label="waves & <peaks>")
    assert len(plot) < 20_000 and plot.count("<polyline") == 2 and plot.count("<rect") == 1
    assert ">9</text>" in plot and "waves &amp; &lt;peaks&gt;" in plot
    assert "polyline" not in svg_plot(np.full(5, np.nan), [], label="nothing")


@pytest.mark.slow
def test_what_moves_is_told_from_the_errors_of_a_real_model(tmp_path: Path) -> None:
    """The model that ships, whose depth and cameras are far from exact."""
    model, variables = load_model("rooms")

    def causes(frames: Frames, name: str) -> set[str | None]:
        (tmp_path / name).mkdir()
        for index, picture in enumerate(frames.images):
            Image.fromarray(picture).save(tmp_path / name / f"{index:03d}.png")
        options = {"longer_edge": max(rooms.SIZE), "progress": False, "num_previews": 0}
        output = tmp_path / f"{name} result"
        health = reconstruct(tmp_path / name, output, model=model, variables=variables, **options).health
        assert health is not None
        return {stretch.cause for stretch in health.stretches}

    for number, step in ((0, 3), (2, 2), (2, 3), (3, 2), (5, 2), (7, 2)):
        still = causes(rooms.walk(range(0, step * rooms.COUNT, step), number=number), f"still {number} {step}")
        assert still <= {None, "fast", "soft"}
    for standing in (False, True):
        assert "moving" in causes(rooms.moving_subject(standing=standing), f"ball {standing}")
