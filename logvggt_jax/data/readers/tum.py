"""TUM RGB-D (Sturm et al., IROS 2012): RGB-D video with motion-capture poses.

Layout: `<root>/rgbd_dataset_freiburg3_walking_xyz/{rgb,depth}/<time>.png` with `rgb.txt`, `depth.txt` and
`groundtruth.txt`, as unpacked from the official archives; see `timed_rgbd` for these and for the prepared form. Poses
are those of the colour camera, camera-to-world, OpenCV axes. Intrinsics are the published ones of the three cameras.
Lens distortion is left in the pictures of freiburg1 and freiburg2; freiburg3's are undistorted.
"""

import re
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, LICENCE_NOT_READ, About
from logvggt_jax.data.formats.calibration import pinhole
from logvggt_jax.data.readers.timed_rgbd import TimedRGBD

_CAMERAS = {
    "1": pinhole(517.3, 516.5, 318.6, 255.3),
    "2": pinhole(520.9, 521.0, 325.1, 249.7),
    "3": pinhole(535.4, 539.2, 320.1, 247.6),
}


class TUM(TimedRGBD):
    """Reader of TUM RGB-D; sequences are named `rgbd_dataset_freiburg3_walking_xyz`.

    The prepared form has no depth in published evaluations, which use it for poses; without `depth_90` the depth
    of its frames is 0 throughout, no pixel valid. A picture there without a pose near it in time is an error.
    """

    name = "tum"
    title = "TUM RGB-D"
    expects = "rgbd_dataset_freiburg3_walking_xyz (or another) with rgb, depth, rgb.txt, depth.txt, groundtruth.txt"
    folder_pattern = re.compile(r"rgbd_dataset_freiburg([123])_\w+")
    container = None
    prepared_for = "poses"
    about = About(
        source="the set's site: an archive a sequence", licence=LICENCE_NOT_READ, size="unknown", roles=(EVALUATION,)
    )

    def _intrinsics(self, folder: Path) -> np.ndarray:
        match = self.folder_pattern.fullmatch(folder.name)
        assert match is not None  # sequences were found by it
        return _CAMERAS[match[1]]
