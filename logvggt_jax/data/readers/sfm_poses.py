"""Structure-from-motion poses of 7-Scenes (Brachmann et al., ICCV 2021), a second set beside the set's own.

Source: `pgt/sfm/7scenes/<scene>_{train,test}.txt` of the repository `visloc_pseudo_gt_limitations`. A line is
`seq-01/frame-000591.color.png qw qx qy qz tx ty tz focal`: world-to-camera of the colour camera, metres, OpenCV axes.
"""

from pathlib import Path

import numpy as np

from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.errors import InputError
from logvggt_jax.geometry import quaternion_to_matrix

_COLUMNS = 9


def read_sfm_poses(path: Path) -> dict[str, np.ndarray]:
    """World-to-camera matrices [4, 4] float64 by `seq-01/frame-000591`.

    Raises InputError naming file and line for a line of another form, or numbers that are no pose.
    """
    poses: dict[str, np.ndarray] = {}
    for number, line in enumerate(SourceFiles().text(path, "structure-from-motion poses").splitlines(), start=1):
        if not line.strip():
            continue
        name, *values = line.split()
        try:
            numbers = np.array(values, np.float64)
        except ValueError:
            numbers = np.array([])
        if len(numbers) != _COLUMNS - 1 or not np.isfinite(numbers).all() or not np.linalg.norm(numbers[:4]) > 0.5:
            raise InputError(
                f"{path}, line {number}: expected `seq-01/frame-000000.color.png qw qx qy qz tx ty tz focal` with a "
                f"unit quaternion, got {line[:80]!r}; fetch the file again"
            )
        pose = np.eye(4)
        pose[:3, :3] = quaternion_to_matrix(numbers[[1, 2, 3, 0]])
        pose[:3, 3] = numbers[4:7]
        poses[name.split(".")[0]] = pose
    return poses
