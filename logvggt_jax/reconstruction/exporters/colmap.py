"""COLMAP models, which 3D Gaussian splatting and most photogrammetry start from; through pycolmap."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.data.feeding.transforms import ResizeTransform
from logvggt_jax.reconstruction.exporters.frame_names import file_stems
from logvggt_jax.reconstruction.exporters.libraries import library
from logvggt_jax.reconstruction.exporters.picture_masks import write_masks
from logvggt_jax.reconstruction.exporters.pictures import Pictures
from logvggt_jax.reconstruction.exporters.tracks import Tracks, find_tracks
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction


def export_colmap(
    result: Reconstruction,
    path: Path,
    *,
    point_filter: PointFilter | None = None,
    progress: bool = True,
    text: bool = False,
) -> None:
    """Fills a folder with `images/` and the model `sparse/0/`: cameras, poses, and a cloud with its observations.

    Where the result has masks, `masks/` has one for each image, `NAME.jpg.png`, black where nothing is to be seen.
    Cameras are PINHOLE at the size of the pictures, one for frames of equal intrinsics; the centre of the first pixel
    is at (0.5, 0.5), as COLMAP has it. Points that one frame alone sees have no observation.

    Args:
      result: the reconstruction.
      path: the folder.
      point_filter: which pixels become points; None for 100,000 points.
      progress: show a progress bar.
      text: write the model as text instead of binary.

    Raises:
      MissingPackage: pycolmap is not installed.
    """
    pycolmap = library("pycolmap")
    pictures = Pictures.of(result)
    files = [f"{stem}.jpg" for stem in file_stems(result.names)]
    tracks = _of_several_frames(find_tracks(result, point_filter, progress=progress))
    model = build_model(
        pycolmap, result.extrinsics, pictures.intrinsics, pictures.size, files, tracks, result.depth_size
    )
    folder = path / "sparse" / "0"
    folder.mkdir(parents=True)
    model.write_text(folder) if text else model.write_binary(folder)
    pictures.write(path / "images", file_stems(result.names), progress=progress)
    if result.masked.any():
        write_masks(result, path / "masks", [f"{file}.png" for file in files], pictures.size)


export_colmap_text = partial(export_colmap, text=True)


def _of_several_frames(tracks: Tracks) -> Tracks:
    """The same points, without the one observation of those that have no other.

    COLMAP's bundle adjustment ends the process where it finds such a point.
    """
    kept = np.bincount(tracks.indices, minlength=len(tracks.points))[tracks.indices] > 1
    return tracks._replace(frames=tracks.frames[kept], indices=tracks.indices[kept], pixels=tracks.pixels[kept])


def build_model(
    pycolmap: Any,
    extrinsics: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    files: list[str],
    tracks: Tracks,
    tracks_size: tuple[int, int],
) -> Any:
    """A `pycolmap.Reconstruction` whose images are numbered from 1 in the order of the frames.

    Args:
      pycolmap: the library.
      extrinsics: [N, 3, 4] world-to-camera.
      intrinsics: [N, 3, 3] in pixels of pictures of `size`, centres at integers.
      size: (H, W) of the pictures.
      files: names of the pictures.
      tracks: points and their observations.
      tracks_size: (h, w) to which the observations' pixels belong.
    """
    model = pycolmap.Reconstruction()
    different, camera_of = np.unique(intrinsics.reshape(len(intrinsics), 9), axis=0, return_inverse=True)
    for number, matrix in enumerate(different.reshape(-1, 3, 3), start=1):
        parameters = [matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5]
        camera = pycolmap.Camera(camera_id=number, model="PINHOLE", width=size[1], height=size[0], params=parameters)
        model.add_camera_with_trivial_rig(camera)
    pixels = ResizeTransform(original_size=size, size=tracks_size).pixels_to_original(tracks.pixels) + 0.5
    borders = np.searchsorted(tracks.frames, np.arange(len(files) + 1))
    for index, file in enumerate(files):
        image = pycolmap.Image(
            name=file,
            keypoints=pixels[borders[index] : borders[index + 1]],
            camera_id=int(camera_of[index]) + 1,
            image_id=index + 1,
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(extrinsics[index]))
    order = np.argsort(tracks.indices, kind="stable")
    images = (tracks.frames + 1)[order].tolist()
    keypoints = (np.arange(len(order)) - borders[tracks.frames])[order].tolist()
    ends = np.cumsum(np.bincount(tracks.indices, minlength=len(tracks.points))).tolist()
    start = 0
    for point, colour, end in zip(tracks.points, tracks.colours, ends, strict=True):
        elements = map(pycolmap.TrackElement, images[start:end], keypoints[start:end])
        model.add_point3D(point, pycolmap.Track(list(elements)), colour)
        start = end
    model.update_point_3d_errors()
    return model
