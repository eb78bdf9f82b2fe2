"""Own recordings in TUM's form: with or without lists and depth, one or many, resized."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from layouts.timed import STEP
from layouts.tum_recording import CALIBRATION, LAYOUT, NAME, write
from room_views import check_views, write_image

from logvggt_jax.data.readers.tum_recording import TUMRecording
from logvggt_jax.errors import InputError

VIEWS = LAYOUT.views
ERRORS = {"picture_error": 0.0, "depth_error": LAYOUT.depth_error}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    write(tmp_path, VIEWS)
    return tmp_path / NAME


def test_folders_without_lists_are_read_by_the_times_in_their_names(recording: Path):
    for kind in ("rgb", "depth"):
        (recording / f"{kind}.txt").unlink()
    frames = TUMRecording(recording.parent).read(NAME, range(5))
    check_views(frames, VIEWS, **ERRORS)


def test_jpeg_pictures_named_by_their_time_are_read(recording: Path):
    (recording / "rgb.txt").unlink()
    for path in (recording / "rgb").iterdir():
        write_image(path.with_suffix(".jpg"), cv2.imread(str(path))[..., ::-1])
        path.unlink()
    check_views(TUMRecording(recording.parent).read(NAME, range(5)), VIEWS, **(ERRORS | {"picture_error": 3.0}))


def test_suffixes_as_cameras_write_them_and_a_calibration_with_tabs_are_read(recording: Path):
    for kind in ("rgb", "depth"):
        (recording / f"{kind}.txt").unlink()
        for path in (recording / kind).iterdir():
            path.rename(path.with_suffix(".PNG"))
    calibration = recording / "calibration.txt"
    calibration.write_text(calibration.read_text().replace(" ", "\t"))
    check_views(TUMRecording(recording).read(NAME, range(5)), VIEWS, **ERRORS)


def test_listed_names_may_have_spaces(recording: Path):
    (recording / "rgb").rename(recording / "left camera")
    listing = recording / "rgb.txt"
    listing.write_text(listing.read_text().replace("rgb/", "left camera/"))
    check_views(TUMRecording(recording).read(NAME, range(5)), VIEWS, **ERRORS)


@pytest.mark.parametrize(("table", "kind"), [("groundtruth.txt", "poses"), ("depth.txt", "depth")])
def test_recorders_with_clocks_of_their_own_are_told_apart(recording: Path, table: str, kind: str):
    lines = [line.split() for line in (recording / table).read_text().splitlines() if not line.startswith("#")]
    (recording / table).write_text("".join(f"{float(time) + 100} {' '.join(rest)}\n" for time, *rest in lines))
    with pytest.raises(InputError, match=rf": no {kind} within 0\.02 s of any picture: {kind} from .* one clock"):
        TUMRecording(recording).num_frames(NAME)


def test_depth_of_another_size_is_told_how_to_mend(recording: Path):
    for path in (recording / "depth").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2])
    with pytest.raises(InputError, match="depth must have the picture's size; bring it to that"):
        TUMRecording(recording).read(NAME, [0])


def test_the_root_itself_may_be_the_recording(recording: Path, monkeypatch: pytest.MonkeyPatch):
    check_views(TUMRecording(recording).read(NAME, range(5)), VIEWS, **ERRORS)
    monkeypatch.chdir(recording)
    assert TUMRecording(Path()).sequences == (NAME,)


def test_recordings_beside_each_other_may_share_a_calibration(recording: Path):
    root = recording.parent
    (recording / "calibration.txt").rename(root / "calibration.txt")
    write(root / "other", VIEWS)
    (root / "other" / NAME).rename(root / "sofa")
    (root / "notes").mkdir()
    dataset = TUMRecording(root)
    assert dataset.sequences == (NAME, "sofa")
    for name in dataset.sequences:
        check_views(dataset.read(name, range(5)), VIEWS, **ERRORS)


def test_without_depth_frames_count_and_have_none(recording: Path):
    (recording / "depth.txt").unlink()
    (recording / "depth").rename(recording / "unused")
    frames = TUMRecording(recording.parent).read(NAME, range(5))
    assert len(frames.images) == 5 and not frames.depth.any()


def test_the_scale_of_depth_is_the_calibrations(recording: Path):
    (recording / "calibration.txt").write_text(f"{CALIBRATION}depth_scale {1 / STEP / 2}  # half a step\n")
    frames = TUMRecording(recording.parent).read(NAME, [0])
    np.testing.assert_allclose(frames.depth[0], 2 * VIEWS[0].depth, atol=2 * LAYOUT.depth_error)


def test_depth_in_units_that_cannot_be_is_named_with_the_file_that_says_so(recording: Path):
    (recording / "calibration.txt").write_text(f"{CALIBRATION}depth_scale 1\n")
    with pytest.raises(InputError, match=r"half of the depth is beyond .* m, with depth_scale=1 in .*calibration\.txt"):
        TUMRecording(recording.parent).read(NAME, [0])


def test_intrinsics_follow_resized_pictures_and_refuse_other_shapes(recording: Path):
    path = recording / "calibration.txt"
    path.write_text("width 128\nheight 96\nfx 110\nfy 110\ncx 62\ncy 49.5\n")
    # c' = (c + 0.5) / 2 - 0.5.
    expected = [[55, 0, 30.75], [0, 55, 24.5], [0, 0, 1]]
    np.testing.assert_allclose(TUMRecording(recording.parent).read(NAME, [0]).intrinsics[0], expected, rtol=1e-6)
    path.write_text("width 96\nheight 128\nfx 110\nfy 110\ncx 47\ncy 60\n")
    with pytest.raises(InputError, match=r"does not have the shape of its calibration .*calibration\.txt"):
        TUMRecording(recording.parent).read(NAME, [0])


@pytest.mark.parametrize("time", ["nan", "inf", "1e300"])
@pytest.mark.parametrize("table", ["rgb", "depth", "groundtruth"])
def test_times_that_are_none_are_named(recording: Path, table: str, time: str):
    path = recording / f"{table}.txt"
    lines = path.read_text().splitlines()
    lines[2] = " ".join([time, *lines[2].split()[1:]])
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=rf"{table}\.txt, line 3: expected a time in seconds"):
        TUMRecording(recording.parent).num_frames(NAME)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16-le", "utf-16-be"])
def test_tables_may_be_written_by_windows(recording: Path, encoding: str):
    """With its line ends and slashes, in the encodings of its editor and its shell."""
    for path in recording.glob("*.txt"):
        text = path.read_text().replace("\n", "\r\n").replace("/", "\\")
        mark = "" if encoding == "utf-8-sig" else "\ufeff"
        path.write_bytes((mark + text).encode(encoding))
    check_views(TUMRecording(recording).read(NAME, range(5)), VIEWS, **ERRORS)


def test_a_calibration_may_begin_with_a_byte_order_mark(recording: Path):
    before = TUMRecording(recording.parent).read(NAME, [0]).intrinsics
    (recording / "calibration.txt").write_text(f"\ufeff{CALIBRATION}", encoding="utf-8")
    np.testing.assert_array_equal(TUMRecording(recording.parent).read(NAME, [0]).intrinsics, before)
