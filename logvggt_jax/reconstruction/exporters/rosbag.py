"""A bag of ROS 2 with pictures, depth, cameras and poses; by rosbags, without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.geometry import invert, matrix_to_quaternion
from logvggt_jax.reconstruction.depth_files import encode_picture
from logvggt_jax.reconstruction.exporters.cloud import tracked
from logvggt_jax.reconstruction.exporters.libraries import library
from logvggt_jax.reconstruction.exporters.original_depth import original_depth
from logvggt_jax.reconstruction.exporters.pictures import Pictures
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction

MAP_FROM_WORLD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Turns a first camera's x right, y down, z forward into x forward, y left, z up, as ROS has its frame `map`."""
_MAP, _CAMERA = "map", "camera_optical_frame"
_BAG = "rosbag2"
_TOPICS = {
    "image": ("/camera/color/image_raw/compressed", "sensor_msgs/msg/CompressedImage"),
    "image_info": ("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo"),
    "depth": ("/camera/depth/image_raw", "sensor_msgs/msg/Image"),
    "depth_info": ("/camera/depth/camera_info", "sensor_msgs/msg/CameraInfo"),
    "pose": ("/camera/pose", "geometry_msgs/msg/PoseStamped"),
    "odometry": ("/camera/odometry", "nav_msgs/msg/Odometry"),
    "transform": ("/tf", "tf2_msgs/msg/TFMessage"),
}


def export_rosbag(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Fills a folder with a bag (SQLite, of the messages of Humble, which later releases read).

    Topics: pictures as JPEG, depth as 32FC1 at the size of the original images (NaN
    where there is none, as REP 118 has it), a camera_info of each with
    pixel centres at integers, and the pose of `camera_optical_frame` in `map` as PoseStamped, Odometry and TF. `map` is
    the first camera's frame, turned to x forward, y left, z up; or as it is the world of the poses that were fused in.
    Stamps are the frames' own.

    Raises MissingPackage without rosbags.
    """
    writing = library("rosbags", "rosbags.rosbag2")
    typesystem = library("rosbags", "rosbags.typesys")
    store = typesystem.get_typestore(typesystem.Stores.ROS2_HUMBLE)
    pictures = Pictures.of(result)
    # The library names its files after the folder.
    with writing.Writer(path / _BAG, version=8) as bag, FramePool() as pool:
        topics = {key: bag.add_connection(topic, kind, typestore=store) for key, (topic, kind) in _TOPICS.items()}
        frames = pool.map(lambda item: _messages(store.types, result, pictures, *item), _numbered(pictures))
        for index, messages in enumerate(tracked(frames, "Bag", result.num_frames, progress=progress)):
            time = _nanoseconds(result.timestamps[index])
            for key, message in messages.items():
                bag.write(topics[key], time, store.serialize_cdr(message, _TOPICS[key][1]))
    for file in (path / _BAG).iterdir():
        file.rename(path / file.name)
    (path / _BAG).rmdir()


def _numbered(pictures: Pictures) -> Iterator[tuple[int, np.ndarray]]:
    with FramePool() as own:
        yield from enumerate(pictures.read(own))


def _messages(types: Any, result: Reconstruction, pictures: Pictures, index: int, image: np.ndarray) -> dict[str, Any]:
    """The messages of one frame by the keys of the topics."""
    seconds, nanoseconds = divmod(_nanoseconds(result.timestamps[index]), 10**9)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)

    def header(frame: str) -> Any:
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    def camera_info(size: tuple[int, int], matrix: np.ndarray) -> Any:
        projection = np.concatenate([matrix, np.zeros((3, 1))], axis=1)
        region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return types["sensor_msgs/msg/CameraInfo"](
            header=header(_CAMERA),
            height=size[0],
            width=size[1],
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=np.ascontiguousarray(matrix).reshape(-1),
            r=np.eye(3).reshape(-1),
            p=projection.reshape(-1),
            binning_x=0,
            binning_y=0,
            roi=region,
        )

    depth = original_depth(result, index)
    depth = np.where(depth > 0, depth, np.float32(np.nan))
    height, width = depth.shape
    pose = np.asarray(invert(result.extrinsics[index]))
    if not result.world_is_given:
        pose = MAP_FROM_WORLD @ pose
    position, quaternion = pose[:3, 3].tolist(), matrix_to_quaternion(pose[:3, :3]).tolist()
    rotation = types["geometry_msgs/msg/Quaternion"](*quaternion)
    placed = types["geometry_msgs/msg/Pose"](position=types["geometry_msgs/msg/Point"](*position), orientation=rotation)
    vector, unknown = types["geometry_msgs/msg/Vector3"], np.zeros(36)
    still = types["geometry_msgs/msg/Twist"](linear=vector(0.0, 0.0, 0.0), angular=vector(0.0, 0.0, 0.0))
    return {
        "transform": types["tf2_msgs/msg/TFMessage"](
            transforms=[
                types["geometry_msgs/msg/TransformStamped"](
                    header=header(_MAP),
                    child_frame_id=_CAMERA,
                    transform=types["geometry_msgs/msg/Transform"](translation=vector(*position), rotation=rotation),
                )
            ]
        ),
        "pose": types["geometry_msgs/msg/PoseStamped"](header=header(_MAP), pose=placed),
        "odometry": types["nav_msgs/msg/Odometry"](
            header=header(_MAP),
            child_frame_id=_CAMERA,
            pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=placed, covariance=unknown),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=still, covariance=unknown),
        ),
        "image_info": camera_info(pictures.size, pictures.intrinsics[index]),
        "image": types["sensor_msgs/msg/CompressedImage"](
            header=header(_CAMERA), format="jpeg", data=np.frombuffer(encode_picture(".jpg", image), np.uint8)
        ),
        "depth_info": camera_info(result.image_size, result.intrinsics[index]),
        "depth": types["sensor_msgs/msg/Image"](
            header=header(_CAMERA),
            height=height,
            width=width,
            encoding="32FC1",
            is_bigendian=0,
            step=4 * width,
            data=depth.astype("<f4").view(np.uint8).reshape(-1),
        ),
    }


def _nanoseconds(timestamp: float) -> int:
    """ROS knows no time before 0."""
    return max(0, round(float(timestamp) * 1e9))
