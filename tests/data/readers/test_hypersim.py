"""HyperSim: exact cameras of tilted and shifted lenses, ray distance, frame numbers, tone map, damage.

Truth is what the set's camera matrix itself says: a pixel's ray, and where it meets the room.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from analytic_room import camera_to_world, disagreement, view
from layouts.hypersim import AXES, camera_from_uv_of, tone_mapped, uv_from_pixels, write_array, write_frame, write_table
from layouts.hypersim import write_keyframes as write_poses
from room_views import SIZE

from logvggt_jax.data.dataset import check_frames
from logvggt_jax.data.readers.hypersim import HyperSim
from logvggt_jax.geometry import project, unproject

# Rays of the OpenGL camera for (u, v, 1): a symmetric frustum; a lens tilted by 22 degrees about x with both shifts.
PLAIN = np.diag([0.577, 0.43275, -1.0])
TILTED = np.array([[0.61, 0, -0.05], [0, 0.42, -0.11], [0, -0.17, -1.05]])


def write_keyframes(scene: Path, count: int = 4, camera: str = "cam_00") -> None:
    write_poses(scene, [camera_to_world(index) for index in range(count)], camera)


@dataclass(frozen=True)
class Ray:
    """What the pixels of a frame see: points [H, W, 3] in the world, distance [H, W], both in metres."""

    image: np.ndarray
    points: np.ndarray
    distance: np.ndarray


def cast(index: int, camera_from_uv: np.ndarray, size: tuple[int, int] = SIZE) -> Ray:
    ray_from_pixel = AXES @ camera_from_uv @ uv_from_pixels(size)
    pose = camera_to_world(index)
    image, along = view(pose, np.linalg.inv(ray_from_pixel), size)
    v, u = np.indices(size)
    camera = along[..., None] * (np.stack([u, v, np.ones(size)], -1) @ ray_from_pixel.T)
    return Ray(image, camera @ pose[:3, :3].T + pose[:3, 3], np.linalg.norm(camera, axis=-1))


def write_scene(
    root: Path, name: str, matrix: np.ndarray, *, size: tuple[int, int] = SIZE, numbers: tuple[int, ...] = (0, 2, 3)
) -> list[Ray]:
    """Four keyframes of cam_00, of which only `numbers` are in the release."""
    seen = [cast(number, matrix, size) for number in numbers]
    for number, rays in zip(numbers, seen, strict=True):
        write_frame(root / name, number, rays.image, rays.distance)
    write_keyframes(root / name)
    return seen


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """One plain scene."""
    write_scene(tmp_path, "ai_001_001", PLAIN)
    write_table(tmp_path, {"ai_001_001": PLAIN, "ai_099_009": TILTED})
    return tmp_path


def final(root: Path, number: int) -> Path:
    return root / f"ai_001_001/images/scene_cam_00_final_hdf5/frame.{number:04d}.color.hdf5"


def geometry(root: Path, number: int, kind: str) -> Path:
    return root / f"ai_001_001/images/scene_cam_00_geometry_hdf5/frame.{number:04d}.{kind}.hdf5"


def test_a_tilted_and_shifted_lens_is_exact_at_the_sets_size(tmp_path: Path):
    seen = write_scene(tmp_path, "ai_038_009", TILTED, size=(768, 1024), numbers=(0, 2))
    write_table(tmp_path, {"ai_038_009": TILTED})
    frames = HyperSim(tmp_path).read("ai_038_009/cam_00", [0, 1])
    check_frames(frames, "HyperSim")
    intrinsics = frames.intrinsics[0]
    assert abs(intrinsics[0, 2] - 511.5) > 20 and abs(intrinsics[1, 2] - 383.5) > 200
    v, u = np.indices((768, 1024))
    for index, rays in enumerate(seen):
        points = rays.points.reshape(-1, 3)
        pixels, z = project(
            points, frames.intrinsics[index].astype(np.float64), frames.extrinsics[index].astype(np.float64)
        )
        assert np.abs(pixels - np.stack([u.ravel(), v.ravel()], -1)).max() < 1e-3
        np.testing.assert_allclose(frames.depth[index].ravel(), z, rtol=2e-6)
        unprojected = unproject(frames.depth[index], frames.intrinsics[index], frames.extrinsics[index])
        assert np.abs(unprojected.reshape(-1, 3) - points).max() < 1e-4
        rotation, translation = frames.extrinsics[index][:3, :3], frames.extrinsics[index][:3, 3]
        centre = camera_to_world((0, 2)[index])[:3, 3]
        np.testing.assert_allclose(-rotation.T @ translation, centre, atol=1e-5)
    # The optical axis is not the stored one: it is tilted by atan(0.17 / 0.42).
    stored, turned = camera_to_world(0)[:3, 2], frames.extrinsics[0][2, :3]
    assert np.degrees(np.arccos(stored @ turned)) == pytest.approx(np.degrees(np.arctan2(0.17, 0.42)), abs=0.01)
    error, share = disagreement(frames, 0, 1)
    assert error < 1e-3 and share > 0.4


def test_intrinsics_and_rotation_are_recovered(tmp_path: Path):
    """A camera built from known intrinsics and rotation, scaled, as the table's matrices have no fixed scale."""
    intrinsics = np.array([[56.0, 0, 20.25], [0, 57.0, 40.5], [0, 0, 1]])
    angle = np.radians(30)
    rotation = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    matrix = camera_from_uv_of(intrinsics, rotation, SIZE)
    write_scene(tmp_path, "ai_002_001", matrix)
    write_table(tmp_path, {"ai_002_001": matrix})
    frames = HyperSim(tmp_path).read("ai_002_001/cam_00", [1])
    np.testing.assert_allclose(frames.intrinsics[0], intrinsics, atol=1e-4)
    turn = np.eye(4)
    turn[:3, :3] = rotation
    np.testing.assert_allclose(frames.extrinsics[0], turn @ np.linalg.inv(camera_to_world(2)), atol=1e-6)


def test_scenes_with_skewed_pixels_are_left_out_and_listed(root: Path):
    width, height = 1024, 768
    for name, skew in (("ai_003_001", 0.7), ("ai_003_002", -0.7), ("ai_003_003", 0.3)):
        matrix = camera_from_uv_of(
            np.array([[890, skew, 511.5], [0, 890, 383.5], [0, 0, 1]]), np.eye(3), (height, width)
        )
        write_scene(root, name, matrix)
        old = (root / "metadata_camera_parameters.csv").read_text()
        write_table(root, {name: matrix})
        row = (root / "metadata_camera_parameters.csv").read_text().splitlines()[1]
        (root / "metadata_camera_parameters.csv").write_text(old + row + "\n")
    for _ in range(2):  # listed, and from the index
        scenes = HyperSim(root)
        assert scenes.sequences == ("ai_001_001/cam_00", "ai_003_003/cam_00")
        assert scenes.skewed_sequences() == ["ai_003_001/cam_00", "ai_003_002/cam_00"]
    check_frames(scenes.read("ai_003_003/cam_00", [0]), "HyperSim")


def test_invalid_distances_become_zero(root: Path):
    distance = np.full(SIZE, 2.0, np.float16)
    distance[0, :5] = [np.nan, np.inf, -np.inf, 0, -1]
    write_array(geometry(root, 0, "depth_meters"), distance)
    frames = HyperSim(root).read("ai_001_001/cam_00", [0])
    assert not frames.depth[0, 0, :5].any() and (frames.depth[0].ravel()[5:] > 1).all()


def test_tone_map_is_exposed_by_the_pixels_that_show_an_object(root: Path):
    generator = np.random.default_rng(0)
    colour = generator.uniform(0.5, 4.0, (*SIZE, 3)).astype(np.float32)
    entities = np.ones(SIZE, np.int16)
    entities[:20] = -1
    colour[:20] *= 1000
    write_array(final(root, 0), colour)
    write_array(geometry(root, 0, "render_entity_id"), entities)
    image = HyperSim(root).read("ai_001_001/cam_00", [0]).images[0]
    expected = tone_mapped(colour.astype(np.float64), entities != -1)
    assert (image[:20] == 255).all()
    # Truncated, not rounded; float32 may fall either side of a whole number.
    assert np.abs(image - np.floor(expected)).max() <= 1 and (image == np.floor(expected)).mean() > 0.999
    assert 100 < image[20:].mean() < 230


def test_tone_map_without_objects_light_or_finite_values(root: Path):
    write_array(geometry(root, 0, "render_entity_id"), np.full(SIZE, -1, np.int16))
    write_array(final(root, 0), np.full((*SIZE, 3), 0.5**2.2, np.float32))
    write_array(final(root, 2), np.full((*SIZE, 3), 5e-5, np.float32))
    colour = np.full((*SIZE, 3), 0.01, np.float16)
    colour[0, 0], colour[0, 1], colour[0, 2] = np.nan, np.inf, -1.0
    write_array(final(root, 3), colour)
    images = HyperSim(root).read("ai_001_001/cam_00", [0, 1, 2]).images
    assert np.isin(images[0], (127, 128)).all()  # unscaled: 0.5 * 255
    assert not images[1].any()  # too dark to expose
    assert not images[2][0, 0].any() and (images[2][0, 1] == 255).all() and not images[2][0, 2].any()
    assert np.isin(images[2][1:], (203, 204)).all()  # 0.8 * 255


def test_splits_are_those_of_the_table_for_scenes_on_disk(root: Path):
    seen = cast(0, PLAIN)
    write_frame(root / "ai_001_001", 0, seen.image, seen.distance, "cam_01")
    write_keyframes(root / "ai_001_001", camera="cam_01")
    write_scene(root, "ai_099_009", TILTED)
    with pytest.raises(FileNotFoundError, match=r"metadata_images_split_scene_v1\.csv.*split='all'"):
        HyperSim(root, "train")
    table = root / "metadata_images_split_scene_v1.csv"
    header = "scene_name,camera_name,frame_id,included_in_public_release,exclude_reason,split_partition_name\n"
    rows = [
        "ai_001_001,cam_00,0,True,,train",
        "ai_001_001,cam_00,1,False,CONTENT FLAGGED FOR REMOVAL,",
        "ai_001_001,cam_01,0,False,CONTENT FLAGGED FOR REMOVAL,train",
        "ai_007_007,cam_00,0,True,,train",
        "ai_099_009,cam_00,0,True,,val",
    ]
    table.write_text(header + "\n".join(rows))
    assert HyperSim(root).sequences == ("ai_001_001/cam_00", "ai_001_001/cam_01", "ai_099_009/cam_00")
    assert HyperSim(root, "train").sequences == ("ai_001_001/cam_00",)
    assert HyperSim(root, "val").sequences == ("ai_099_009/cam_00",)
    with pytest.raises(FileNotFoundError, match="no sequences of HyperSim"):
        HyperSim(root, "test")
    table.write_text(header + "\n".join(rows[:-1]))
    with pytest.raises(ValueError, match=r"split_scene_v1\.csv: no row for ai_099_009/cam_00"):
        HyperSim(root, "train")
    table.write_text("scene,split\nai_001_001,train\n")
    with pytest.raises(ValueError, match=r"split_scene_v1\.csv: no column 'scene_name'"):
        HyperSim(root, "train")
