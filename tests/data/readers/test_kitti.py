"""KITTI depth: no poses, both layouts, frames start where depth does; points lie on the room's walls."""

from pathlib import Path

import numpy as np
import pytest
from layouts.kitti import DATE, DRIVE, LAYOUT, SPARSE, write, write_calibration, write_frames
from room_views import SIZE, check_views, write_image

from logvggt_jax.data.readers.kitti import KITTI

GATHERED = Path("depth_selection/val_selection_cropped")


def test_pictures_outside_the_range_of_depth_do_not_count(tmp_path: Path):
    write(tmp_path)
    for number in (0, 1, 9):
        write_image(tmp_path / f"{DATE}/{DRIVE}/image_02/data/{number:010d}.png", np.zeros((*SIZE, 3), np.uint8))
    kitti = KITTI(tmp_path)
    assert kitti.frame_names(DRIVE) == LAYOUT.names and kitti.dropped_frames(DRIVE) == {"no depth": 3}


def test_depth_and_calibration_put_points_on_the_walls(tmp_path: Path):
    write(tmp_path)
    frames = KITTI(tmp_path).read(DRIVE, [3])
    depth = frames.depth[0].astype(np.float64)
    v, u = np.nonzero(depth)
    points = np.linalg.inv(frames.intrinsics[0].astype(np.float64)) @ np.stack([u, v, np.ones(len(u))]) * depth[v, u]
    world = SPARSE[3].pose[:3, :3] @ points + SPARSE[3].pose[:3, 3:]
    furthest = np.abs(np.abs(world) / np.array([[2.5], [1.4], [3.0]])).max(0)
    assert furthest.min() > 0.998 and furthest.max() < 1.002


@pytest.mark.parametrize("suffix", ["", "_50"])
def test_the_gathered_form_comes_back(tmp_path: Path, suffix: str):
    folder = f"{DRIVE}_02"
    write_frames(
        tmp_path / GATHERED / f"image_gathered{suffix}" / folder,
        tmp_path / GATHERED / f"groundtruth_depth_gathered{suffix}" / folder,
    )
    write_calibration(tmp_path)
    kitti = KITTI(tmp_path, "val")
    name = f"{DRIVE}/image_gathered{suffix}"
    assert kitti.sequences == (name,) and kitti.frame_names(name) == LAYOUT.names
    check_views(kitti.read(name, range(4)), SPARSE, picture_error=0, depth_error=LAYOUT.depth_error, poses=False)
    with pytest.raises(FileNotFoundError, match="no sequences of KITTI depth"):
        KITTI(tmp_path, "train")
    # Annotations without raw pictures do not hide it, a whole drive does.
    write(tmp_path / "whole")
    (tmp_path / "whole/val").rename(tmp_path / "val")
    assert KITTI(tmp_path).sequences == (name,)
    (tmp_path / f"whole/{DATE}/{DRIVE}").rename(tmp_path / DATE / DRIVE)
    assert KITTI(tmp_path).sequences == (DRIVE,)


def test_splits_are_the_folders(tmp_path: Path):
    other = "2011_09_28_drive_0001_sync"
    write(tmp_path)
    write(tmp_path, drive=other, part="train")
    assert KITTI(tmp_path).sequences == (DRIVE, other)
    assert KITTI(tmp_path, "val").sequences == (DRIVE,)
    assert KITTI(tmp_path, "train").sequences == (other,)


def test_gathered_pictures_and_depth_of_unequal_count_are_named(tmp_path: Path):
    folder = f"{DRIVE}_02"
    depths = tmp_path / GATHERED / "groundtruth_depth_gathered" / folder
    write_frames(tmp_path / GATHERED / "image_gathered" / folder, depths)
    write_calibration(tmp_path)
    (depths / "0000000007.png").unlink()
    with pytest.raises(FileNotFoundError, match=rf"groundtruth_depth_gathered/{folder}/0000000007\.png: no such file"):
        KITTI(tmp_path).num_frames(f"{DRIVE}/image_gathered")
