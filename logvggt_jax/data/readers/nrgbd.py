"""Neural RGB-D (Azinović et al., CVPR 2022): synthetic RGB-D video of rooms with exact depth and poses.

Layout: `<root>/<scene>/images/img<n>.png`, `depth/depth<n>.png`, `focal.txt` and `poses.txt`, from the official
repository's data set. Numbers are not padded and start at 0. `depth` is uint16 in millimetres, 0 where invalid;
`depth_filtered` and `depth_with_noise`, which imitate a sensor, and `trainval_poses.txt` are not read. `poses.txt`
holds four lines a frame, camera-to-world in metres with OpenGL camera axes (x right, y up, z back); `nan` for frames
without a pose. `focal.txt` is the focal length for 640 x 480; the principal point is (320, 240) there.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from logvggt_jax.data.dataset import EVALUATION, About
from logvggt_jax.data.formats.calibration import OPENGL_AXES, in_pixels, numbers, pinhole, relative, world_to_camera
from logvggt_jax.data.formats.image import read_depth, read_rgb
from logvggt_jax.data.formats.numbered_files import numbered_frames, without_gaps
from logvggt_jax.data.formats.pose_lists import read_pose_list
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import INDOORS, Dropped, FolderDataset, FrameRecord, frame

_CENTRE, _SIZE = (320.0, 240.0), (480, 640)
_MAX_DEPTH = 10.0  # metres, valid itself


class NRGBD(FolderDataset):
    """Reader of Neural RGB-D; sequences are named as their scenes, `kitchen`.

    Depth beyond 10 m becomes 0, as in published evaluations. Intrinsics scale with the image. Frames without a pose
    are dropped.
    """

    name = "nrgbd"
    title = "Neural RGB-D"
    expects = "<scene>/{images,depth,focal.txt,poses.txt}"
    metric = True
    plausible_depth = INDOORS
    splits = ("all",)
    about = About(
        source="repository dazinovic/neural-rgbd-surface-reconstruction",
        licence="CC BY or CC0, by scene",
        size="7.25 GB",
        roles=(EVALUATION,),
    )

    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        return files.folders_with(("images", "poses.txt"), self.root, "scenes")

    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterator[FrameRecord | Dropped]:
        kinds = ((folder / "images", "img{}.png"), (folder / "depth", "depth{}.png"))
        paths = without_gaps(numbered_frames(files, *kinds))
        pose_list = folder / "poses.txt"
        poses = read_pose_list(files, pose_list, count=len(paths), numbers_per_line=4)
        path = folder / "focal.txt"
        (focal,) = numbers(files.text(path, "the focal length"), path, count=1)
        intrinsics = relative(pinhole(focal, focal, *_CENTRE), _SIZE)
        for (image, depth), pose in zip(paths, poses, strict=True):
            opencv = pose * OPENGL_AXES.diagonal()
            extrinsics = world_to_camera(opencv, f"{pose_list}, pose of {image.name}", stored="camera_to_world")
            yield frame(image, depth, intrinsics, extrinsics, calibration=path)

    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image = read_rgb(record.image)
        depth = read_depth(record.depth).astype(np.float32) / np.float32(1000.0)
        depth[depth > _MAX_DEPTH] = 0.0
        return image, depth, in_pixels(record.intrinsics, image.shape[:2], record.image, record.calibration)
