"""Whatever damage a copy has, its reader gives frames or one line that names a file in it; it neither hangs nor breaks.

Values that are finite in a file and infinite in float32 never reach a model.
"""

import errno
import gzip
import json
import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from damage import CONTENT_DAMAGES, PLACE_DAMAGES, damaged_copies
from layouts.layout import Layout
from readers.test_contract import NAMES, layout_of, named, opened

from logvggt_jax.data.dataset import check_frames
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.errors import InputError

_LIMIT = 20  # seconds, for one read


@pytest.fixture(autouse=True)
def time_limit() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TimeoutError("a read did not come back")

    before = signal.signal(signal.SIGALRM, stop)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def read_all(layout: Layout, root: Path) -> None:
    signal.alarm(_LIMIT)
    dataset = opened(layout, root)
    for sequence in dataset.sequences:
        frames = dataset.read(sequence, range(dataset.num_frames(sequence)))
        check_frames(frames, sequence, poses=False)
    signal.alarm(0)


def check_damages(layout: Layout, root: Path, files: list[str], damages: tuple[str, ...]) -> int:
    """Reads the copy in `root` after each of the `damages` to each file; the number of errors."""
    errors = 0
    for what in damaged_copies(root, [root / name for name in files], damages, seed=0):
        try:
            read_all(layout, root)
        except InputError as error:
            errors += 1
            assert str(root) in str(error) and "\n" not in str(error), (what, str(error))
        except Exception as error:
            raise AssertionError(f"{what}: {error!r}") from error
    return errors


@pytest.mark.parametrize("name", NAMES)
def test_damaged_calibrations_poses_and_lists_give_frames_or_one_line_with_a_file(name: str, tmp_path: Path):
    layout = layout_of(name)
    layout.write(tmp_path, layout.views)
    assert check_damages(layout, tmp_path, list(layout.tables), tuple(CONTENT_DAMAGES)) >= 3 * len(layout.tables)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_no_file_or_may_not_be_read_is_named_and_never_waited_for(name: str, tmp_path: Path):
    layout = layout_of(name)
    layout.write(tmp_path, layout.views)
    damages = tuple(each for each in PLACE_DAMAGES if os.getuid() or each != "no permission")
    files = [*layout.tables, layout.image, layout.depth]
    # Without its table of constants Replica has those of its paper, and a folder in a picture's place is none.
    assert check_damages(layout, tmp_path, files, damages) >= len(damages) * (len(files) - 1)


# PointOdyssey's files hold float32 themselves.
@pytest.mark.parametrize(
    "name", [name for name in NAMES if layout_of(name).poses == "matrix" and name != "pointodyssey"]
)
def test_poses_that_leave_float32_are_lost(name: str, tmp_path: Path):
    layout = layout_of(name)
    for length in (1e39, 1e300):
        root = tmp_path / f"{length:g}"
        far = layout.views[1].pose.copy()
        far[0, 3] = length
        layout.write(root, [*layout.views[:1], replace(layout.views[1], pose=far), *layout.views[2:]])
        dataset = opened(layout, root)
        assert dataset.dropped_frames(layout.sequence) == {"no pose": 1}
        read_all(layout, root)


@pytest.mark.parametrize("name", ["mvs_synth", "virtual_kitti", "spring", "sintel"])
def test_intrinsics_that_leave_float32_are_lost(name: str, tmp_path: Path):
    layout = layout_of(name)
    huge = np.diag([1e39, 1e39, 1.0])
    layout.write(tmp_path, [replace(layout.views[0], intrinsics=huge), *layout.views[1:]])
    assert opened(layout, tmp_path).dropped_frames(layout.sequence) == {"no intrinsics": 1}


@pytest.mark.parametrize("focal", ["nan", "1e39", "1e300"])
def test_a_calibration_of_a_whole_sequence_that_leaves_float32_is_named(tmp_path: Path, focal: str):
    layout = layout_of("nrgbd")
    layout.write(tmp_path, layout.views)
    (tmp_path / "kitchen/focal.txt").write_text(focal)
    with pytest.raises(InputError) as error:
        opened(layout, tmp_path).read(layout.sequence, [0])
    assert named(error, str(tmp_path / "kitchen/focal.txt"))


def test_what_leaves_a_copy_without_sequences_is_named(tmp_path: Path):
    for name, file, complaint in (
        ("scannet", "scans_train/scene0000_00/intrinsic/intrinsic_depth.txt", "intrinsics are not finite"),
        ("co3dv2", "apple/sequence_annotations.jgz", "viewpoint_quality_score above 0.5"),
    ):
        layout, root = layout_of(name), tmp_path / name
        layout.write(root, layout.views)
        if name == "scannet":
            np.savetxt(root / file, np.full((4, 4), np.nan))
        else:
            scores = json.loads(gzip.decompress((root / file).read_bytes()))
            without = [{**each, "viewpoint_quality_score": None} for each in scores]
            (root / file).write_bytes(gzip.compress(json.dumps(without).encode()))
        with pytest.raises(InputError, match=complaint) as error:
            opened(layout, root)
        assert named(error, str(root / file))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("sequence_name",), 5),
        (("image", "path"), 5),
        (("image", "size"), [float("inf"), 64]),
        (("image", "size"), [0, 64]),
        (("depth", "path"), 5),
        (("depth", "mask_path"), 5),
        (("depth", "scale_adjustment"), float("inf")),
        (("depth",), [1]),
        (("viewpoint", "intrinsics_format"), 5),
        (("viewpoint", "R"), 10**400),
        (("frame_number",), float("inf")),
    ],
)
def test_co3d_annotations_of_another_type_are_named(tmp_path: Path, place: tuple[str, ...], value: object):
    layout = layout_of("co3dv2")
    layout.write(tmp_path, layout.views)
    (path,) = tmp_path.glob("*/frame_annotations.jgz")
    annotations = json.loads(gzip.decompress(path.read_bytes()))
    holder = annotations[1]
    for key in place[:-1]:
        holder = holder[key]
    holder[place[-1]] = value
    path.write_bytes(gzip.compress(json.dumps(annotations).encode()))
    with pytest.raises(InputError) as error:
        opened(layout, tmp_path).num_frames(layout.sequence)
    assert named(error, str(path))


@pytest.mark.parametrize("table", ["intrinsic", "extrinsic"])
@pytest.mark.parametrize("column", [0, 1])
@pytest.mark.parametrize("number", ["inf", "nan", "1.5"])
def test_virtual_kitti_rows_without_whole_numbers_are_named(tmp_path: Path, table: str, column: int, number: str):
    layout = layout_of("virtual_kitti")
    layout.write(tmp_path, layout.views)
    path = tmp_path / f"Scene01/clone/{table}.txt"
    header, row, *rows = path.read_text().splitlines()
    words = row.split()
    words[column] = number
    path.write_text("\n".join([header, " ".join(words), *rows]))
    with pytest.raises(InputError, match="expected a whole number") as error:
        opened(layout, tmp_path).num_frames(layout.sequence)
    assert named(error, f"{path}, line 2")


def test_lists_whose_names_cannot_be_names_are_refused(tmp_path: Path):
    for name in ("a\0b", "a\ud800b"):
        with pytest.raises(InputError, match="cannot be the name of a file"):
            SourceFiles().content(tmp_path / name, "a file")
    with pytest.raises(InputError, match="name too long"):
        SourceFiles().content(tmp_path / ("a" * 300), "a file")


@pytest.mark.parametrize("kind", ["image", "depth", "table"])
def test_files_that_may_not_be_read_are_named(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch):
    """As another user than the superuser meets them."""
    layout = layout_of("scannet")
    layout.write(tmp_path, layout.views)
    refused = tmp_path / (layout.tables[0] if kind == "table" else getattr(layout, kind))
    read = Path.read_bytes

    def read_bytes(path: Path) -> bytes:
        if path == refused:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", read_bytes)
    with pytest.raises(InputError, match="Permission denied") as error:
        read_all(layout, tmp_path)
    assert named(error, f"{refused}: ")


def test_depth_that_leaves_float32_is_invalid(tmp_path: Path):
    layout = layout_of("hypersim")
    layout.write(tmp_path, layout.views)
    path = tmp_path / layout.depth
    with h5py.File(path, "r+") as file:
        distance = file["dataset"][()].astype(np.float64)
        distance[0], distance[1], distance[2], distance[3] = 1e39, np.nan, -1, 1e300
        del file["dataset"]
        file["dataset"] = distance
    depth = opened(layout, tmp_path).read(layout.sequence, [1]).depth[0]
    assert not depth[:4].any() and depth[4:].all()


def test_links_to_files_are_followed(tmp_path: Path):
    (tmp_path / "text").write_text("there")
    (tmp_path / "link").symlink_to("text")
    assert SourceFiles().text(tmp_path / "link", "text") == "there"
