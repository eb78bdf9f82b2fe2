"""A result folder, read back: cameras, depth, images and points of a reconstruction."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from logvggt_jax.errors import InputError, disk_errors, printable
from logvggt_jax.files import user_path
from logvggt_jax.reconstruction.cameras_file import CAMERAS_FILE, read_cameras
from logvggt_jax.reconstruction.depth_files import (
    DEPTH_FOLDER,
    IMAGE_FOLDER,
    depth_file,
    image_file,
    read_depth,
    read_picture,
)
from logvggt_jax.reconstruction.health.report import HEALTH_FILE, HEALTH_PAGE, Health, read_health
from logvggt_jax.reconstruction.points.cloud_file import Cloud, count_points, read_cloud, read_points
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result_folder import POINTS_FILE, PREVIEW_FOLDER, TRAJECTORY_FILE
from logvggt_jax.reconstruction.sources.record import SourceRecord
from logvggt_jax.reconstruction.work_folder import is_unfinished


@dataclasses.dataclass(frozen=True, eq=False)
class Reconstruction:
    """What `reconstruct` has written; the one way to read it for viewer and exporters.

    Attributes:
      folder: where it lies.
      names: N frame names, in order.
      timestamps: [N] float64, seconds of a video, positions in a folder.
      extrinsics: [N, 3, 4] float64, world-to-camera (OpenCV); the world is the first camera's frame, or that of poses
        that were fused in.
      intrinsics: [N, 3, 3] float64, pixels of the original images.
      depth_intrinsics: [N, 3, 3] float64, pixels of depth, confidence and image; centres at integers.
      image_size: (H, W) of the original images.
      depth_size: (h, w) of depth, confidence and image.
      metric: whether lengths are metres; else they are up to one common scale.
      world_is_given: whether the world is that of poses that were fused in, whose axes may be any.
      complete: False if the run was ended before the end of its source.
      skipped: names of frames that could not be read and are left out.
      noted_focal_length: pixels of the original images, the median of what the camera noted in EXIF; None where it did
        not.
      source: where the frames came from; None where they cannot be read again.
      depth_scale: [N] float64, by which the depth files' depth is multiplied where it is read, so that it fits the
        extrinsics.
      loops: pairs of frames at which the sequence came back to a place; None where nobody looked for them.
      masked: [N] float64, the share of the depth maps' pixels that a mask has dropped, which have depth and confidence
        0; zeros where there were no masks.
      timed: whether time stamps are seconds, and not positions; None where that is not known.
      point_filter: which pixels became points.
      seconds: from the first frame to the last depth map, compilation included; None for a folder opened later.
    """

    folder: Path
    names: tuple[str, ...]
    timestamps: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    depth_intrinsics: np.ndarray
    image_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_scale: np.ndarray
    metric: bool = False
    world_is_given: bool = False
    loops: tuple[tuple[int, int], ...] | None = None
    complete: bool = True
    skipped: tuple[str, ...] = ()
    noted_focal_length: float | None = None
    source: SourceRecord | None = None
    masked: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    timed: bool | None = None
    point_filter: PointFilter = PointFilter()
    seconds: float | None = None

    @classmethod
    def open(cls, folder: str | Path) -> Reconstruction:
        """The reconstruction in a folder that `reconstruct` has written.

        Raises:
          InputError: the folder is not one, its cameras cannot be used, or a file is missing or cut off. What else is
            wrong with a file is said when it is read.
        """
        folder = user_path(folder)
        with disk_errors(folder):
            if folder.is_file():
                raise InputError(f"{folder} is a file: give the folder that `logvggt reconstruct` has made")
        result = cls.with_cameras_of(folder)
        files = [depth_file(folder, name) for name in result.names]
        with disk_errors(folder / IMAGE_FOLDER):
            if (folder / IMAGE_FOLDER).exists():  # results of earlier versions have none
                files += [image_file(folder, name) for name in result.names]
        for file in files:
            with disk_errors(file):
                if not file.is_file():
                    raise InputError(f"{file} is missing: the reconstruction is damaged or incomplete; make it again")
        count_points(folder / POINTS_FILE)
        return result

    @classmethod
    def with_cameras_of(cls, folder: Path) -> Reconstruction:
        """As `open`, for a folder that holds cameras and whose other files need not be complete."""
        document = read_cameras(folder / CAMERAS_FILE)
        frames = document["frames"]

        def stacked(key: str) -> np.ndarray:
            return np.stack([frame[key] for frame in frames])

        return cls(
            folder=folder,
            names=tuple(frame["name"] for frame in frames),
            timestamps=np.array([frame["timestamp"] for frame in frames], np.float64),
            extrinsics=stacked("extrinsics"),
            intrinsics=stacked("intrinsics"),
            depth_intrinsics=stacked("depth_intrinsics"),
            image_size=tuple(document["image_size"]),
            depth_size=tuple(document["depth_size"]),
            metric=document["metric"],
            world_is_given=document["world_is_given"],
            depth_scale=np.array([frame["depth_scale"] for frame in frames], np.float64),
            loops=None if document["loops"] is None else tuple((a, b) for a, b in document["loops"]),
            complete=document["complete"],
            noted_focal_length=document["noted_focal_length"],
            skipped=tuple(frame["name"] for frame in document["skipped"]),
            source=document["source"],
            masked=np.array([frame["masked"] for frame in frames], np.float64),
            timed=document["timed"],
            point_filter=document["points"],
        )

    def filtered(self, max_points: int | None) -> PointFilter:
        """The result's point filter, for another number of points."""
        return dataclasses.replace(self.point_filter, max_points=max_points)

    @property
    def num_frames(self) -> int:
        """Frames of the sequence."""
        return len(self.names)

    @property
    def num_points(self) -> int:
        """Points of the cloud."""
        return count_points(self.folder / POINTS_FILE)

    def depth(self, index: int) -> np.ndarray:
        """Depth of a frame, [h, w] float32: z-depth in the unit of the extrinsics, 0 where there is none."""
        return self.depth_and_confidence(index)[0]

    def confidence(self, index: int) -> np.ndarray:
        """Confidence of a frame's depth, [h, w] float32, at least 1; 0 where a mask has dropped the pixel."""
        return self.depth_and_confidence(index)[1]

    def depth_and_confidence(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Both of one frame, in one reading."""
        depth, confidence = self.stored_depth(index)
        return depth * np.float32(self.depth_scale[index]), confidence

    def stored_depth(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Depth and confidence of a frame as its file has them, before `depth_scale`."""
        return read_depth(depth_file(self.folder, self.names[index]), self.depth_size)

    def image(self, index: int) -> np.ndarray:
        """A frame as the model saw it, [h, w, 3] uint8 RGB, to the few grey levels that JPEG costs."""
        return read_picture(image_file(self.folder, self.names[index]), self.depth_size)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """The cloud: points [M, 3] float32 in the world, and colours [M, 3] uint8."""
        return read_points(self.folder / POINTS_FILE)

    def cloud(self) -> Cloud:
        """The cloud with the confidence and the frame of every point, where the file holds them."""
        cloud = read_cloud(self.folder / POINTS_FILE)
        if cloud.frame is not None and (cloud.frame[-1:] >= self.num_frames).any():
            raise InputError(
                f"{self.folder / POINTS_FILE} is not of this reconstruction: it has points of frame "
                f"{cloud.frame[-1]:,}, there are {self.num_frames:,}; reconstruct again"
            )
        return cloud

    @property
    def health(self) -> Health | None:
        """Which frames are doubtful and why; None for results of earlier versions, and those made from another.

        Raises:
          InputError: `health.json` is damaged.
        """
        return read_health(self.folder)

    def summary(self) -> str:
        """One line a result, with its place; for people, so that a name's control characters are shown as escapes."""
        height, width = self.depth_size
        scaled = f"; times depth_scale of {CAMERAS_FILE}" if (self.depth_scale != 1).any() else ""
        has_previews = (self.folder / PREVIEW_FOLDER).is_dir()
        lines = [
            (CAMERAS_FILE, f"intrinsics and world-to-camera extrinsics of {self.num_frames} frames"),
            (TRAJECTORY_FILE, "camera-to-world trajectory, TUM format"),
            (f"{DEPTH_FOLDER}/*.npz", f"depth and confidence, {height} x {width}, float16{scaled}"),
            (f"{IMAGE_FOLDER}/*.jpg", "the frames at that size"),
            *([(f"{PREVIEW_FOLDER}/*.png", "some images beside their depth")] if has_previews else []),
            (POINTS_FILE, f"{self.num_points:,} coloured points"),
        ]
        took = ""
        if self.seconds:
            took = f" in {self.seconds:.1f} s ({self.num_frames / self.seconds:.2f} frames/s)"
        notes = [] if self.complete else ["ended early"]
        if is_unfinished(self.folder):
            notes = ["ended early: the same command goes on from here"]
        if self.skipped:
            notes.append(f"{len(self.skipped)} frames left out: {', '.join(map(printable, self.skipped[:5]))}")
        if self.masked.any():
            notes.append(f"masked: {self.masked.mean():.0%} of the pixels, which have no depth and no points")
        if self.loops is not None:
            pairs = ", ".join(f"{self.names[a]} with {self.names[b]}" for a, b in self.loops[:5])
            notes.append(f"loops closed: {len(self.loops)}" + (f" ({printable(pairs)})" if pairs else ""))
        if self.noted_focal_length:
            focal = float(np.median(self.intrinsics[:, 0, 0]))
            notes.append(
                f"focal length: {focal:.0f} pixels in the result, {self.noted_focal_length:.0f} by the camera's EXIF"
            )
        try:
            health = self.health
        except InputError as error:
            notes.append(printable(str(error)))
        else:
            if health is not None:
                notes.append(f"health: {health.in_short}")
                lines.append((HEALTH_PAGE, f"the word on that, with plots; its numbers are in {HEALTH_FILE}"))
        folder = printable(str(self.folder))
        return "\n".join(
            [f"{self.num_frames} frames{took}", *notes, *(f"  {folder}/{name}: {what}" for name, what in lines)]
        )


def preview_file(folder: Path, name: str) -> Path:
    """Where a result folder keeps the preview of the frame of this name, if it has one."""
    return folder / PREVIEW_FOLDER / f"{name}.png"
