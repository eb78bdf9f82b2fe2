"""Own recordings in TUM's form: as the sets in that form, with a calibration file."""

from collections.abc import Sequence
from pathlib import Path

from room_views import INTRINSICS, SIZE, RoomView, room_views

from layouts.layout import Layout, relined, removed, written
from layouts.timed import DEPTHS, NAMES, PICTURES, STEP, write_sequence
from logvggt_jax.data.readers.tum_recording import TUMRecording

NAME = "desk"
CALIBRATION = f"""# of the camera in the office
width {SIZE[1]}
height {SIZE[0]}
fx {INTRINSICS[0, 0]}
fy {INTRINSICS[1, 1]}
cx {INTRINSICS[0, 2]}
cy {INTRINSICS[1, 2]}
"""


def write(root: Path, views: Sequence[RoomView]) -> None:
    write_sequence(root / NAME, views)
    (root / NAME / "calibration.txt").write_text(CALIBRATION)


IMAGE, DEPTH = f"{NAME}/rgb/{PICTURES[1]:.6f}.png", f"{NAME}/depth/{DEPTHS[1]:.6f}.png"
TABLES = tuple(f"{NAME}/{table}.txt" for table in ("rgb", "depth", "groundtruth", "calibration"))
LAYOUT = Layout(
    TUMRecording,
    NAME,
    write,
    names=NAMES,
    image=IMAGE,
    depth=DEPTH,
    needed=(IMAGE, DEPTH, TABLES[2]),
    tables=TABLES,
    views=room_views(5),
    depth_error=0.51 * STEP,
    damages=(
        (r"calibration\.txt: no such file", removed(TABLES[3])),
        (r"calibration\.txt: no line fx, cy", relined(TABLES[3], lambda lines: [*lines[:3], *lines[4:6]])),
        (r"calibration\.txt, line 8: expected each of .* got 'k4'", written(TABLES[3], f"{CALIBRATION}k4 0.1\n")),
        (r"calibration\.txt, line 8: expected each of .* got 'fx'", written(TABLES[3], f"{CALIBRATION}fx 50\n")),
        (r"calibration\.txt, line 8: expected 1 numbers, got 0", written(TABLES[3], f"{CALIBRATION}depth_scale\n")),
        (r"calibration\.txt: .* depth_scale must be from 1", written(TABLES[3], f"{CALIBRATION}depth_scale 0\n")),
        (r"calibration\.txt: expected a whole number", relined(TABLES[3], lambda lines: ["width inf", *lines[2:]])),
        (r"calibration\.txt: intrinsics must be finite", relined(TABLES[3], lambda x: [*x[:3], "fx nan", *x[4:]])),
        (r"calibration\.txt: .* distortion too", written(TABLES[3], f"{CALIBRATION}k1 nan\n")),
        (r"calibration\.txt: intrinsics fx=", relined(TABLES[3], lambda x: [*x[:3], "fx 1", "fy 1", *x[5:]])),
    ),
)
