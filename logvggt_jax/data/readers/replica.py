"""Replica (Straub et al., 2019) as rendered for iMAP and NICE-SLAM: RGB-D video of eight rooms and offices.

Layout: `<root>/cam_params.json` and per scene `<root>/<scene>/traj.txt`, `results/frame000000.jpg` and
`results/depth000000.png`. `cam_params.json` holds `{"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}`; pixel
centres are at integers. A line of `traj.txt` is one frame's camera-to-world matrix, 16 numbers row-major, metres,
OpenCV axes. Depth is uint16, `scale` a metre, 0 where invalid. Other renderings of Replica are not read.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import TRAINING, About
from logvggt_jax.data.formats.calibration import in_pixels, pinhole, relative, world_to_camera
from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.data.formats.json_values import expecting, read_json
from logvggt_jax.data.formats.numbered_files import numbered_frames, without_gaps
from logvggt_jax.data.formats.pose_lists import read_pose_list
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import INDOORS, Dropped, FolderDataset, FrameRecord, frame
from logvggt_jax.errors import InputError

# The rendering's own, for downloads that lack the file.
_CAMERA = {"w": 1200.0, "h": 680.0, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}
_MAX = 1e6  # pixels, and units of depth a metre


class Replica(FolderDataset):
    """Reader of Replica in the NICE-SLAM rendering; sequences are named `office0`.

    The camera of `cam_params.json` belongs to pictures of the size named there and scales with pictures of another
    size; without the file it is the rendering's (1200 x 680, focal length 600, 6553.5 a metre).
    """

    name = "replica"
    title = "Replica"
    expects = "cam_params.json and <scene>/{traj.txt,results} (the rendering that NICE-SLAM distributes)"
    metric = True
    plausible_depth = INDOORS
    splits = ("all",)
    about = About(
        source="the rendering that the download script of the repository cvg/nice-slam fetches; the official meshes "
        "hold no pictures",
        licence="Replica's research terms: non-commercial research or education",
        size="8 scenes of 2,000 frames each (inferred); bytes unknown",
        roles=(TRAINING,),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        return files.folders_with(("results", "traj.txt"), self.root, "scenes")

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        path = self.root / "cam_params.json"
        calibration = path if files.exists(path) else None
        camera = _CAMERA if calibration is None else _camera(calibration, files)
        results, trajectory = folder / "results", folder / "traj.txt"
        paths = without_gaps(numbered_frames(files, (results, "frame{:06d}.jpg"), (results, "depth{:06d}.png")))
        poses = read_pose_list(files, trajectory, count=len(paths))
        # At 1 x 1 the intrinsics fit pictures of any size.
        matrix = pinhole(camera["fx"], camera["fy"], camera["cx"], camera["cy"])
        intrinsics = relative(matrix, (int(camera["h"]), int(camera["w"])))
        for line, ((image, depth), pose) in enumerate(zip(paths, poses, strict=True), 1):
            extrinsics = world_to_camera(pose, f"{trajectory}, line {line}", stored="camera_to_world")
            others = {"depth_scale": 1 / camera["scale"], "calibration": calibration}
            yield frame(image, depth, intrinsics, extrinsics, **others)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        depth = (read_depth(record.depth) * record.depth_scale).astype(np.float32)
        return image, depth, in_pixels(record.intrinsics, image.shape[:2], record.image, record.calibration)


def _camera(path: Path, files: SourceFiles) -> Mapping[str, float]:
    content = read_json(files.text(path, "the camera"), path)
    with expecting(path, f'{{"camera": {{{", ".join(_CAMERA)}}}}} with numbers'):
        values = {key: float(content["camera"][key]) for key in _CAMERA}
    if not all(1 <= values[key] <= _MAX for key in ("w", "h", "scale")):
        raise InputError(f"{path}: w, h and scale must be from 1 to {_MAX:g}, got {values}: fetch the file again")
    return values
