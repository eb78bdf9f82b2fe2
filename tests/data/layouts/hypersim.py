"""HyperSim: HDF5 of linear colour and ray distance, cameras as a matrix from the picture's borders to rays."""

from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
from room_views import INTRINSICS, SIZE, RoomView

from layouts.layout import Layout, written
from logvggt_jax.data.readers.hypersim import HyperSim

UNIT = 0.0254
AXES = np.diag([1.0, -1.0, -1.0])  # OpenGL to OpenCV and back
NAME, SCENE = "ai_001_001/cam_00", "ai_001_001"
TABLE = "metadata_camera_parameters.csv"


def uv_from_pixels(size: tuple[int, int]) -> np.ndarray:
    """[3, 3]; a picture's borders are at -1 and 1, v up, pixel centres half a pixel inside."""
    height, width = size
    return np.array([[2 / width, 0, 1 / width - 1], [0, -2 / height, 1 - 1 / height], [0, 0, 1]])


def camera_from_uv_of(intrinsics: np.ndarray, rotation: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The set's matrix for a camera with `intrinsics` in pixels whose frame is turned by `rotation`; it has no fixed
    scale."""
    return 1.7 * AXES @ rotation.T @ np.linalg.inv(intrinsics) @ np.linalg.inv(uv_from_pixels(size))


PLAIN = camera_from_uv_of(INTRINSICS, np.eye(3), SIZE)


def write_array(path: Path, array: np.ndarray, name: str = "dataset") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.create_dataset(name, data=array)


def linear(picture: np.ndarray) -> np.ndarray:
    return ((picture + 0.5) / 255) ** 2.2 * 3.0


def tone_mapped(colour: np.ndarray, shown: np.ndarray | None = None) -> np.ndarray:
    """As the set's owners do it, before it is truncated to whole levels."""
    brightness = 0.3 * colour[..., 0] + 0.59 * colour[..., 1] + 0.11 * colour[..., 2]
    scale = 0.8**2.2 / np.percentile(brightness if shown is None else brightness[shown], 90)
    return 255 * np.clip((scale * colour) ** (1 / 2.2), 0, 1)


def write_frame(scene: Path, number: int, picture: np.ndarray, distance: np.ndarray, camera: str = "cam_00") -> None:
    geometry = scene / f"images/scene_{camera}_geometry_hdf5"
    final = scene / f"images/scene_{camera}_final_hdf5/frame.{number:04d}.color.hdf5"
    write_array(final, linear(picture).astype(np.float32))
    write_array(geometry / f"frame.{number:04d}.depth_meters.hdf5", distance.astype(np.float32))
    write_array(geometry / f"frame.{number:04d}.render_entity_id.hdf5", np.ones(picture.shape[:2], np.int16))


def write_keyframes(scene: Path, poses: Sequence[np.ndarray], camera: str = "cam_00") -> None:
    detail = scene / "_detail" / camera
    write_array(detail / "camera_keyframe_orientations.hdf5", np.stack([pose[:3, :3] @ AXES for pose in poses]))
    write_array(detail / "camera_keyframe_positions.hdf5", np.stack([pose[:3, 3] / UNIT for pose in poses]))
    text = f"parameter_name,parameter_value\nmeters_per_asset_unit,{UNIT}\n"
    (scene / "_detail/metadata_scene.csv").write_text(text)


def write_table(root: Path, scenes: dict[str, np.ndarray], width: float = 1024.0) -> None:
    columns = [f"M_cam_from_uv_{i}{j}" for i in range(3) for j in range(3)]
    lines = [",".join(["scene_name", "settings_output_img_width", "camera_physical_bmpaperture_tex", *columns])]
    for scene, matrix in scenes.items():
        lines.append(",".join([scene, str(width), '"AColor(0, 0, 0, 0)"', *map(repr, matrix.ravel().tolist())]))
    (root / TABLE).write_text("\n".join(lines) + "\n")


def distance_of(depth: np.ndarray) -> np.ndarray:
    v, u = np.indices(depth.shape)
    rays = np.stack([u, v, np.ones(depth.shape)], -1) @ np.linalg.inv(INTRINSICS).T
    return depth * np.linalg.norm(rays, axis=-1)


def write(root: Path, views: Sequence[RoomView]) -> None:
    """Frame 1 is not in the release."""
    numbers = (0, 2, 3, 4)
    for number, each in zip(numbers, views, strict=True):
        write_frame(root / SCENE, number, each.picture, distance_of(each.depth))
    write_keyframes(root / SCENE, [views[0].pose, views[0].pose, *(each.pose for each in views[1:])])
    write_table(root, {SCENE: PLAIN, "ai_099_009": np.eye(3)})


GEOMETRY = f"{SCENE}/images/scene_cam_00_geometry_hdf5/frame.0002"
FILES = (f"{SCENE}/images/scene_cam_00_final_hdf5/frame.0002.color.hdf5", f"{GEOMETRY}.depth_meters.hdf5")
ENTITIES = f"{GEOMETRY}.render_entity_id.hdf5"
TABLES = [
    f"{SCENE}/_detail/{name}"
    for name in (
        "metadata_scene.csv",
        "cam_00/camera_keyframe_positions.hdf5",
        "cam_00/camera_keyframe_orientations.hdf5",
    )
]
LAYOUT = Layout(
    HyperSim,
    NAME,
    write,
    names=[f"frame.{number:04d}" for number in (0, 2, 3, 4)],
    image=FILES[0],
    depth=FILES[1],
    needed=(*FILES, ENTITIES, *TABLES, TABLE),
    tables=(*TABLES, TABLE),
    developed=lambda picture: np.floor(tone_mapped(linear(picture))),
    picture_error=0.05,
    damages=(
        *(
            (
                rf"camera_parameters\.csv: M_cam_from_uv of {SCENE} {complaint}",
                lambda root, matrix=matrix: write_table(root, {SCENE: matrix}),
            )
            for matrix, complaint in (
                (np.diag([1.0, 1, 0]), "has no inverse"),
                (np.full((3, 3), np.nan), "has no inverse"),
                (np.diag([0.577, 0.433, 1.0]), "mirrors"),
            )
        ),
        (
            rf"camera_parameters\.csv: expected M_cam_from_uv_00.*{SCENE}",
            written(TABLE, f"scene_name,M_cam_from_uv_00\n{SCENE},zero\n"),
        ),
        (rf"camera_parameters\.csv: no row for {SCENE}", lambda root: write_table(root, {"ai_099_009": PLAIN})),
        (
            r"positions\.hdf5: expected numbers of shape 5 x 3.*\(3, 3\)",
            lambda root: write_array(root / TABLES[1], np.zeros((3, 3))),
        ),
        (
            "_detail/cam_00: expected a keyframe for each frame up to 4, got 3",
            lambda root: write_keyframes(root / SCENE, [np.eye(4)] * 3),
        ),
        *(
            (r"metadata_scene\.csv: expected a row meters_per_asset_unit", written(TABLES[0], text))
            for text in (
                "",
                "parameter_name,parameter_value\nmeters_per_asset_unit,0\n",
                "meters_per_asset_unit,inch\n",
            )
        ),
        *(
            (
                rf"{name}: expected numbers of shape .*\(24, 32\)",
                lambda root, name=name, kind=kind: write_array(root / name, np.zeros((24, 32), kind)),
            )
            for name, kind in ((FILES[0], np.float32), (FILES[1], np.float32), (ENTITIES, np.int16))
        ),
    ),
)
