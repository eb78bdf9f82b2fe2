"""Bonn RGB-D Dynamic (Palazzolo et al., IROS 2019): RGB-D video of moving people and things.

Layout: `<root>/rgbd_bonn_balloon2/{rgb,depth}/<time>.png` with `rgb.txt`, `depth.txt` and `groundtruth.txt`, or the
same below `<root>/rgbd_bonn_dataset`; see `timed_rgbd` for these and for the prepared form (`rgb_110`: pictures 30 to
139 of the sequence).
Poses are handed out as stored, camera-to-world of the motion capture's frame on the sensor, which need not be the
camera's optical frame: use them for relative trajectory errors only. Intrinsics are the published ones; lens
distortion is left in the pictures.
"""

import re
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, LICENCE_NOT_READ, About
from logvggt_jax.data.formats.calibration import pinhole
from logvggt_jax.data.readers.timed_rgbd import TimedRGBD


class Bonn(TimedRGBD):
    """Reader of Bonn RGB-D Dynamic; sequences are named `rgbd_bonn_balloon2`.

    The prepared form cuts the trajectory by line, not by time, so that it does not cover the pictures. Where a picture
    there has no pose near it in time, all frames of the sequence get NaN extrinsics and count, for depth
    evaluation.
    """

    name = "bonn"
    title = "Bonn RGB-D Dynamic"
    expects = "rgbd_bonn_balloon2 (or another) with rgb, depth, rgb.txt, depth.txt, groundtruth.txt"
    folder_pattern = re.compile(r"rgbd_bonn_\w+")
    container = "rgbd_bonn_dataset"
    prepared_for = "depth"
    about = About(
        source="the set's site; published evaluations use balloon2, crowd2, crowd3, person_tracking2 and synchronous",
        licence=LICENCE_NOT_READ,
        size="unknown",
        roles=(EVALUATION,),
    )

    def _intrinsics(self, folder: Path) -> np.ndarray:
        return pinhole(542.822841, 542.576870, 315.593520, 237.756098)
