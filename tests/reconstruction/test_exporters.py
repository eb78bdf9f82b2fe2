"""Every export is read back by a library that its users read it with, and agrees with the result."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import json
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from room_result import write_room_result

from logvggt_jax.data import open_dataset
from logvggt_jax.errors import DiskError, InputError, MissingPackage, OutputExists
from logvggt_jax.geometry import camera_centres, invert, project, unproject_pixels
from logvggt_jax.reconstruction import EXPORTERS, PointFilter, Reconstruction, export
from logvggt_jax.reconstruction.depth_files import depth_file, write_depth
from logvggt_jax.reconstruction.exporters import frame_bytes
from logvggt_jax.reconstruction.exporters.frame_names import file_stems
from logvggt_jax.reconstruction.exporters.glb import _times
from logvggt_jax.reconstruction.exporters.libraries import library
from logvggt_jax.reconstruction.exporters.original_depth import depth_at
from logvggt_jax.reconstruction.points.cloud_file import read_cloud, read_points

COUNT = 6
FEW_POINTS = PointFilter(max_points=600)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    return write_room_result(tmp_path_factory.mktemp("room"), count=COUNT)


@pytest.fixture(scope="module")
def exports(result: Reconstruction, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with every export."""
    folder = tmp_path_factory.mktemp("exports")
    before = contents(result.folder)
    written = export(result, list(EXPORTERS), folder, point_filter=FEW_POINTS, progress=False)
    assert {path.name for path in folder.iterdir()} == {path.name for path in written}, "nothing lies beside"
    assert contents(result.folder) == before, "the result is only read"
    return folder


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def original(result: Reconstruction, index: int) -> np.ndarray:
    """The picture that a frame came from."""
    return np.asarray(Image.open(result.folder.parent / "source" / f"{result.names[index]}.png"))


def assert_is_picture(picture: np.ndarray, expected: np.ndarray) -> None:
    """Equal but for what JPEG costs."""
    assert picture.shape == expected.shape
    assert np.abs(picture.astype(int) - expected).mean() < 1.5


# COLMAP


@pytest.mark.parametrize("name", ["colmap", "colmap-text"])
def test_colmap_reads_cameras_points_and_their_observations(result: Reconstruction, exports: Path, name: str) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    model = pycolmap.Reconstruction(exports / name / "sparse" / "0")
    assert model.is_valid()
    assert model.num_reg_images() == COUNT and model.num_points3D() == 600
    for index in range(COUNT):
        image = model.image(index + 1)
        np.testing.assert_allclose(image.cam_from_world().matrix(), result.extrinsics[index], atol=1e-6)
        # What COLMAP projects is what we project, half a pixel apart.
        point = invert(result.extrinsics[index])[:3] @ [0.3, -0.2, 2.0, 1.0]
        pixel, _ = project(point[None], result.intrinsics[index], result.extrinsics[index])
        np.testing.assert_allclose(image.project_point(point), pixel[0] + 0.5, atol=1e-6)
        assert (image.camera.height, image.camera.width) == result.image_size
        with Image.open(exports / name / "images" / image.name) as picture:
            assert_is_picture(np.asarray(picture), original(result, index))
    errors = [point.error for point in model.points3D.values()]
    assert max(errors) < 1e-3, "observations lie where the points project to"
    lengths = [point.track.length() for point in model.points3D.values()]
    assert np.mean(lengths) > 2, "points are seen by several frames"


def test_the_text_model_has_the_fields_that_other_readers_count(exports: Path) -> None:
    """Brush, LichtFeld Studio and SuperSplat split its lines at single blanks and take images by two lines each."""
    pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    folder = exports / "colmap-text" / "sparse" / "0"
    lines = {
        name: [line for line in (folder / f"{name}.txt").read_text().splitlines() if not line.startswith("#")]
        for name in ("cameras", "images", "points3D")
    }
    assert [len(line.split(" ")) for line in lines["cameras"]] == [8]
    assert [len(line.split(" ")) for line in lines["images"][::2]] == [10] * COUNT
    assert len(lines["images"]) == 2 * COUNT and all(len(line.split()) % 3 == 0 for line in lines["images"][1::2])
    assert len(lines["points3D"]) == 600
    assert all((fields := len(line.split())) >= 8 and fields % 2 == 0 for line in lines["points3D"])


def test_colmap_adjusts_the_model(exports: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    model = pycolmap.Reconstruction(exports / "colmap" / "sparse" / "0")
    # COLMAP ends the process at a point with one observation.
    assert 1 not in {point.track.length() for point in model.points3D.values()}
    pycolmap.bundle_adjustment(model, pycolmap.BundleAdjustmentOptions(print_summary=False))
    assert model.num_points3D() == 600


def test_the_cloud_of_colmap_has_the_pictures_colours(result: Reconstruction, exports: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    model = pycolmap.Reconstruction(exports / "colmap" / "sparse" / "0")
    wrong = []
    for point in filter(lambda point: point.track.length(), model.points3D.values()):
        element = point.track.elements[0]
        u, v = model.image(element.image_id).points2D[element.point2D_idx].xy / 96 * 42 - 0.5
        picture = result.image(element.image_id - 1)
        seen = picture[np.clip(round(v), 0, 41), np.clip(round(u), 0, 55)]
        wrong.append(np.abs(seen.astype(int) - point.color).mean())
    assert np.median(wrong) < 8


def test_points_are_observed_only_where_nothing_is_before_them(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    from logvggt_jax.reconstruction.depth_files import depth_file, write_depth
    from logvggt_jax.reconstruction.exporters.tracks import find_tracks

    result = write_room_result(tmp_path, count=3, source=False)
    # Something large stands close before the last camera.
    write_depth(depth_file(result.folder, result.names[2]), np.full(result.depth_size, 0.2), np.full((42, 56), 2.0))
    tracks = find_tracks(result, FEW_POINTS, progress=False)
    depth = project(tracks.points, result.depth_intrinsics[2], result.extrinsics[2])[1]
    seen = tracks.indices[tracks.frames == 2]
    assert len(seen) and (np.abs(depth[seen] - 0.2) < 0.01).all()
    assert np.isin([0, 1], tracks.frames).all()


def test_our_own_reader_reads_what_colmap_was_given(result: Reconstruction, exports: Path) -> None:
    data = open_dataset("colmap", exports / "colmap")
    frames = data.read(data.sequences[0], list(range(COUNT)))
    np.testing.assert_allclose(frames.extrinsics[:, :3], result.extrinsics, atol=1e-6)
    np.testing.assert_allclose(frames.intrinsics, result.intrinsics, rtol=1e-6)


def test_frames_of_one_calibration_share_a_camera(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="extra `colmap` is not installed")
    result = write_room_result(tmp_path, count=3)
    document = json.loads((result.folder / "cameras.json").read_text())
    document["frames"][1]["intrinsics"][0][0] += 1.0
    (result.folder / "cameras.json").write_text(json.dumps(document))
    (folder,) = export(Reconstruction.open(result.folder), ["colmap"], point_filter=FEW_POINTS, progress=False)
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    assert model.num_cameras() == 2
    assert model.image(1).camera_id == model.image(3).camera_id != model.image(2).camera_id


# nerfstudio, GLB, PLY, splats


def test_transforms_json_has_the_cameras_in_opengls_axes(result: Reconstruction, exports: Path) -> None:
    folder = exports / "nerfstudio"
    document = json.loads((folder / "transforms.json").read_text())
    assert document["camera_model"] == "OPENCV"
    point = unproject_pixels(
        result.depth(2)[None], result.depth_intrinsics[2:3], result.extrinsics[2:3], np.array([1000])
    )
    frame = document["frames"][2]
    x, y, z = (np.linalg.inv(frame["transform_matrix"]) @ [*point[0], 1.0])[:3]
    assert z < 0, "a camera looks along -z"
    pixel = [frame["fl_x"] * x / -z + frame["cx"], frame["fl_y"] * -y / -z + frame["cy"]]
    expected = project(point, result.intrinsics[2], result.extrinsics[2])[0][0] + 0.5
    np.testing.assert_allclose(pixel, expected, atol=1e-6)
    with Image.open(folder / frame["file_path"]) as picture:
        assert (frame["h"], frame["w"]) == (picture.height, picture.width) == result.image_size
    points, colours = read_points(folder / document["ply_file_path"])
    assert len(points) == 600 and colours.std() > 10


def test_transforms_json_has_one_lens_for_all_frames_where_they_share_it(
    result: Reconstruction, exports: Path, tmp_path: Path
) -> None:
    """nerfstudio takes the file's own lens for every frame; LichtFeld Studio (64cf588) looks nowhere else."""
    lens = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    document = json.loads((exports / "nerfstudio" / "transforms.json").read_text())
    assert all(document[name] == frame[name] for frame in document["frames"] for name in lens)
    other = write_room_result(tmp_path, count=3)
    cameras = json.loads((other.folder / "cameras.json").read_text())
    cameras["frames"][1]["intrinsics"][0][0] += 1.0
    (other.folder / "cameras.json").write_text(json.dumps(cameras))
    (folder,) = export(Reconstruction.open(other.folder), ["nerfstudio"], point_filter=FEW_POINTS, progress=False)
    document = json.loads((folder / "transforms.json").read_text())
    assert not set(lens) & set(document) and all(set(lens) < set(frame) for frame in document["frames"])


def splats_of(path: Path) -> np.ndarray:
    trimesh = pytest.importorskip("trimesh", reason="extra `formats` is not installed")
    return trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]


def test_splats_are_as_wide_as_their_neighbours_are_far(result: Reconstruction, exports: Path) -> None:
    splats, cloud = splats_of(exports / "splats.ply"), read_cloud(exports / "points.ply")
    np.testing.assert_array_equal(np.stack([splats[axis] for axis in "xyz"], axis=-1), cloud.points)
    # A harmonic of degree 0 has one value everywhere, 1 / sqrt(4 pi).
    shown = 0.5 + np.stack([splats[f"f_dc_{channel}"] for channel in range(3)], axis=-1) / np.sqrt(4 * np.pi)
    np.testing.assert_allclose(shown * 255, cloud.colours, atol=1e-3)
    np.testing.assert_allclose(1 / (1 + np.exp(-splats["opacity"])), 0.95, atol=1e-6)
    np.testing.assert_array_equal([splats[f"rot_{part}"][0] for part in range(4)], [1, 0, 0, 0])
    distances = np.sort(np.linalg.norm(cloud.points[:, None] - cloud.points[None], axis=-1), axis=1)
    near = np.sqrt(np.mean(distances[:, 1:4] ** 2, axis=1))
    frame = cloud.frame
    z = np.einsum("ni,ni->n", result.extrinsics[frame, 2, :3], cloud.points) + result.extrinsics[frame, 2, 3]
    # Between the pixels that a frame of 42 x 56 hands out, at their depth.
    gap = z / result.depth_intrinsics[frame, 0, 0] * np.sqrt(42 * 56 / np.bincount(frame)[frame])
    for axis in range(3):
        np.testing.assert_allclose(np.exp(splats[f"scale_{axis}"]), np.clip(near, gap / 10, gap), rtol=1e-4)


def test_splats_leave_no_holes_in_what_a_camera_saw(result: Reconstruction, tmp_path: Path) -> None:
    (path,) = export(result, ["splats"], tmp_path, point_filter=PointFilter(max_points=6000), progress=False)
    splats = splats_of(path)
    widths = np.exp(splats["scale_0"]).astype(float)
    centres = np.stack([splats[axis] for axis in "xyz"], axis=-1)
    pixels = np.arange(0, 42 * 56, 5)
    seen = unproject_pixels(result.depth(2)[None], result.depth_intrinsics[2:3], result.extrinsics[2:3], pixels)
    rays = seen - camera_centres(result.extrinsics[2:3])
    lengths = np.linalg.norm(rays, axis=-1, keepdims=True)
    # What a ball hides of a ray depends on how near it passes; those far from the surface hide other things.
    away = centres[None] - seen[:, None]
    along = np.einsum("pnc,pc->pn", away, rays / lengths)
    beside = np.maximum((away**2).sum(-1) - along**2, 0)
    hidden = np.where(np.abs(along) < 0.2, 0.95 * np.exp(-beside / (2 * widths**2)), 0)
    through = np.prod(1 - hidden, axis=1)
    assert np.mean(through > 0.2) < 0.01


def test_splats_of_two_points_have_a_width(result: Reconstruction, tmp_path: Path) -> None:
    (path,) = export(result, ["splats"], tmp_path, point_filter=PointFilter(max_points=2), progress=False)
    widths = np.exp(splats_of(path)["scale_0"])
    assert len(widths) == 2 and np.isfinite(widths).all() and (widths > 0).all()


def test_trimesh_reads_points_and_frusta_of_the_scene(result: Reconstruction, exports: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="extra `formats` is not installed")
    scene = trimesh.load(exports / "scene.glb")
    cloud, frusta = scene.geometry["points"], scene.geometry["cameras"]
    turned = [1, -1, -1]
    points, colours = read_points(exports / "points.ply")
    np.testing.assert_allclose(np.asarray(cloud.vertices) * turned, points, atol=1e-6)
    # In glTF colours of points are linear: half of the light is 188 in a picture.
    shown = np.asarray(cloud.colors)[:, :3] / 255
    np.testing.assert_allclose(shown[colours > 40] ** (1 / 2.2), colours[colours > 40] / 255, atol=0.03)
    centres = camera_centres(result.extrinsics) * turned
    distances = np.linalg.norm(np.asarray(frusta.vertices)[None] - centres[:, None], axis=-1)
    assert distances.min(1).max() < 1e-6, "every camera is the tip of a frustum"


def test_the_camera_of_the_scene_flies_the_path(result: Reconstruction, exports: Path) -> None:
    gltf = pytest.importorskip("pygltflib", reason="extra `dev` is not installed").GLTF2().load(exports / "scene.glb")
    (animation,) = gltf.animations

    def values(accessor: int) -> np.ndarray:
        found = gltf.accessors[accessor]
        view = gltf.bufferViews[found.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[found.type]
        content = gltf.binary_blob()[view.byteOffset : view.byteOffset + 4 * width * found.count]
        return np.frombuffer(content, np.float32).reshape(-1, width)

    outputs = {channel.target.path: animation.samplers[channel.sampler] for channel in animation.channels}
    assert {gltf.nodes[channel.target.node].camera for channel in animation.channels} == {0}
    np.testing.assert_allclose(values(outputs["translation"].input)[:, 0], result.timestamps)
    np.testing.assert_allclose(
        values(outputs["translation"].output), camera_centres(result.extrinsics) * [1, -1, -1], atol=1e-6
    )
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_quat(values(outputs["rotation"].output)).as_matrix()
    # Forward is the camera's -z.
    np.testing.assert_allclose(-axes[:, :, 2], result.extrinsics[:, 2, :3] * [1, -1, -1], atol=1e-6)
    np.testing.assert_allclose(axes[:, :, 1], -result.extrinsics[:, 1, :3] * [1, -1, -1], atol=1e-6)
    view = gltf.cameras[0].perspective
    assert view.yfov == pytest.approx(2 * np.arctan(48 / result.intrinsics[0, 1, 1]))


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_what_is_up_in_a_given_world_is_up_in_the_scene(up: str, tmp_path: Path) -> None:
    """A robot's poses have z up; programs that open a GLB hold y for it. Coordinates stay, but for order and sign."""
    trimesh = pytest.importorskip("trimesh", reason="extra `formats` is not installed")
    result = write_room_result(tmp_path, count=2)
    world = np.zeros((3, 3))  # from the room's world, in which y is down
    world["xyz".index(up[1]), 1] = -1 if up[0] == "+" else 1
    world["yzx".index(up[1]), 2] = 1
    world[:, 0] = np.cross(world[:, 1], world[:, 2])
    document = json.loads((result.folder / "cameras.json").read_text())
    document["world_is_given"] = True
    for frame in document["frames"]:
        extrinsics = np.array(frame["extrinsics"])
        frame["extrinsics"] = np.hstack([extrinsics[:, :3] @ world.T, extrinsics[:, 3:]]).tolist()

    def vertices(output: str) -> np.ndarray:
        reopened = Reconstruction.open(result.folder)
        (file,) = export(reopened, ["glb"], tmp_path / output, point_filter=FEW_POINTS, progress=False)
        return np.asarray(trimesh.load(file).geometry["points"].vertices)

    expected = vertices("own")
    (result.folder / "cameras.json").write_text(json.dumps(document))
    found = vertices("given")
    np.testing.assert_allclose(found[:, 1], expected[:, 1], atol=1e-6)
    turn = np.linalg.lstsq(expected, found, rcond=None)[0]
    np.testing.assert_allclose(np.sort(np.abs(turn), axis=0), [[0] * 3, [0] * 3, [1] * 3], atol=1e-5)
    assert np.linalg.det(turn) == pytest.approx(1, abs=1e-4)


def test_the_camera_of_the_scene_is_as_wide_as_the_frames(tmp_path: Path) -> None:
    pytest.importorskip("trimesh", reason="extra `formats` is not installed")
    reader = pytest.importorskip("pygltflib", reason="extra `dev` is not installed")
    result = write_room_result(tmp_path, count=1)
    document = json.loads((result.folder / "cameras.json").read_text())
    document["frames"][0]["intrinsics"][0][0] *= 1.1
    (result.folder / "cameras.json").write_text(json.dumps(document))
    result = Reconstruction.open(result.folder)
    (file,) = export(result, ["glb"], point_filter=FEW_POINTS, progress=False)
    view = reader.GLTF2().load(file).cameras[0].perspective
    assert np.tan(view.yfov / 2) * view.aspectRatio == pytest.approx(64 / result.intrinsics[0, 0, 0])


# Camera paths


@pytest.mark.parametrize("name", ["tum", "kitti", "euroc"])
def test_evo_reads_the_camera_paths(result: Reconstruction, exports: Path, name: str) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface", reason="extra `eval` is not installed")
    read = {
        "tum": file_interface.read_tum_trajectory_file,
        "kitti": file_interface.read_kitti_poses_file,
        "euroc": file_interface.read_euroc_csv_trajectory,
    }[name]
    path = read(str(exports / EXPORTERS[name].file))
    np.testing.assert_allclose(np.stack(path.poses_se3), invert(result.extrinsics), atol=1e-6)
    if name != "kitti":
        np.testing.assert_allclose(path.timestamps, result.timestamps, atol=1e-6)


# Depth


def read_png(folder: Path, file: str, document: dict[str, Any]) -> np.ndarray:
    levels = cv2.imread(str(folder / file), cv2.IMREAD_UNCHANGED)
    assert levels.dtype == np.uint16
    return levels * document["scale"]


def read_exr(folder: Path, file: str, document: dict[str, Any]) -> np.ndarray:
    openexr = pytest.importorskip("OpenEXR", reason="extra `formats` is not installed")
    with openexr.File(str(folder / file)) as picture:
        channels = picture.channels()
        # What OpenCV reads, whose wheels do not all have the format.
        np.testing.assert_array_equal(channels["Y"].pixels, channels["Z"].pixels)
        return channels["Z"].pixels


def read_npz(folder: Path, file: str, document: dict[str, Any]) -> np.ndarray:
    with np.load(folder / file) as arrays:
        assert arrays["confidence"].shape == arrays["depth"].shape and (arrays["confidence"] == 2).all()
        np.testing.assert_array_equal(arrays["intrinsics"], document["frames"][int(file[5])]["intrinsics"])
        return arrays["depth"]


@pytest.mark.parametrize(
    ("name", "read", "step"), [("depth-png", read_png, 5.1e-4), ("depth-exr", read_exr, 0), ("depth-npz", read_npz, 0)]
)
def test_depth_has_the_size_of_the_originals(
    result: Reconstruction, exports: Path, name: str, read: Callable, step: float
) -> None:
    document = json.loads((exports / name / "depth.json").read_text())
    assert document["unit"] == "metre" and document.get("scale", 0.001) == 0.001
    for index, frame in enumerate(document["frames"]):
        depth = read(exports / name, frame["file"], document)
        assert depth.shape == result.image_size
        np.testing.assert_allclose(depth, depth_at(result.depth(index), result.image_size), atol=step)
        np.testing.assert_array_equal(frame["intrinsics"], result.intrinsics[index])
        np.testing.assert_array_equal(frame["extrinsics"], result.extrinsics[index])


def test_enlarged_depth_is_exact_on_planes_and_mixes_no_two_surfaces() -> None:
    size, large = (20, 30), (70, 96)

    def plane(shape: tuple[int, int]) -> np.ndarray:
        v, u = ((np.arange(length) + 0.5) / length for length in shape)
        return (1 / (0.2 + 0.1 * u[None] + 0.05 * v[:, None])).astype(np.float32)

    enlarged = depth_at(plane(size), large)
    inside = (slice(2, -2), slice(2, -2))
    np.testing.assert_allclose(enlarged[inside], plane(large)[inside], rtol=1e-5)
    step = np.where(np.arange(30) < 13, 1.0, 2.0) * np.ones((20, 1))
    step[5, 5] = np.nan
    enlarged = depth_at(step, large)
    np.testing.assert_array_equal(np.unique(enlarged), [0, 1, 2])
    assert (enlarged == 0).mean() == pytest.approx(1 / 600, rel=0.3)


def test_depth_without_a_unit_keeps_its_precision_whatever_lies_far_away(tmp_path: Path) -> None:
    from logvggt_jax.reconstruction.depth_files import depth_file, write_depth

    result = write_room_result(tmp_path, count=1, image_size=(42, 56), metric=False)
    depth = result.depth(0)
    depth[0, :5] = 6e4
    write_depth(depth_file(result.folder, result.names[0]), depth, np.full(depth.shape, 2.0))
    (folder,) = export(result, ["depth-png"], progress=False)
    document = json.loads((folder / "depth.json").read_text())
    assert document["unit"] != "metre"
    read = read_png(folder, "view_0.png", document)
    assert (read[0, :5] == 0).all()
    np.testing.assert_allclose(read[1:], depth[1:], rtol=2e-3)


# ROS


def test_rosbags_reads_pictures_depth_cameras_and_poses(result: Reconstruction, exports: Path) -> None:
    pytest.importorskip("rosbags", reason="extra `formats` is not installed")
    from rosbags.highlevel import AnyReader

    messages: dict[str, list] = {}
    with AnyReader([exports / "rosbag2"]) as reader:
        for connection, time, content in reader.messages():
            message = reader.deserialize(content, connection.msgtype)
            messages.setdefault(connection.topic, []).append((time, message))
    assert {topic: len(found) for topic, found in messages.items()} == dict.fromkeys(messages, COUNT)
    assert len(messages) == 7
    index = 3
    times = {topic: found[index][0] for topic, found in messages.items()}
    assert set(times.values()) == {round(result.timestamps[index] * 1e9)}
    at = {topic: found[index][1] for topic, found in messages.items()}
    picture = cv2.imdecode(at["/camera/color/image_raw/compressed"].data, cv2.IMREAD_COLOR)[..., ::-1]
    assert_is_picture(picture, original(result, index))
    image = at["/camera/depth/image_raw"]
    depth = image.data.view(np.float32).reshape(image.height, image.width)
    np.testing.assert_array_equal(depth, depth_at(result.depth(index), result.image_size))
    for name in ("color", "depth"):
        info = at[f"/camera/{name}/camera_info"]
        np.testing.assert_array_equal(info.k.reshape(3, 3), result.intrinsics[index])
        assert (info.height, info.width) == result.image_size
    placed = at["/camera/pose"].pose
    transform = at["/tf"].transforms[0]
    assert placed == at["/camera/odometry"].pose.pose
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "camera_optical_frame")
    # Ahead of the first camera of an upright room is x, its right -y, its down -z.
    x, y, z = camera_centres(result.extrinsics)[index]
    np.testing.assert_allclose([placed.position.x, placed.position.y, placed.position.z], [z, -x, -y], atol=1e-9)
    q = placed.orientation
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    right, _, forward = result.extrinsics[index, :, :3]
    np.testing.assert_allclose(axes[:, 2], [forward[2], -forward[0], -forward[1]], atol=1e-6)
    np.testing.assert_allclose(axes[:, 0], [right[2], -right[0], -right[1]], atol=1e-6)


def test_the_map_of_ros_is_the_world_of_poses_that_were_fused_in(result: Reconstruction, tmp_path: Path) -> None:
    """A robot's odometry has z up already."""
    pytest.importorskip("rosbags", reason="extra `formats` is not installed")
    from rosbags.highlevel import AnyReader

    given = dataclasses.replace(result, folder=shutil.copytree(result.folder, tmp_path / "fused"), world_is_given=True)
    (folder,) = export(given, ["rosbag2"], tmp_path / "exports", progress=False)
    with AnyReader([folder]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic == "/camera/pose"]
        found = [
            reader.deserialize(content, connection.msgtype).pose for connection, _, content in reader.messages(wanted)
        ]
    places = [[pose.position.x, pose.position.y, pose.position.z] for pose in found]
    np.testing.assert_allclose(places, camera_centres(result.extrinsics), atol=1e-9)


def test_no_depth_is_nan_for_ros(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="extra `formats` is not installed")
    from rosbags.highlevel import AnyReader

    result = masked_result(tmp_path)
    (folder,) = export(result, ["rosbag2"], progress=False)
    with AnyReader([folder]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic == "/camera/depth/image_raw"]
        messages = list(reader.messages(wanted))
        assert len(messages) == result.num_frames
        for index, (connection, _, content) in enumerate(messages):
            depth = reader.deserialize(content, connection.msgtype).data.view(np.float32).reshape(result.image_size)
            there = depth_at(result.depth(index), result.image_size) > 0
            assert not there.all() and (depth[there] > 0).all() and np.isnan(depth[~there]).all()


def test_masks_go_with_the_pictures_of_nerfstudio(tmp_path: Path) -> None:
    result = masked_result(tmp_path)
    (folder,) = export(result, ["nerfstudio"], point_filter=FEW_POINTS, progress=False)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    assert len(frames) == result.num_frames
    for index, frame in enumerate(frames):
        with Image.open(folder / frame["mask_path"]) as mask:
            assert mask.mode == "L" and mask.size == (frame["w"], frame["h"])
            np.testing.assert_array_equal(
                np.asarray(mask) > 0, depth_at(result.confidence(index), result.image_size) > 0
            )


@pytest.mark.parametrize(
    ("timestamps", "timed", "times"),
    [
        ([0, 3, 6], False, [0, 0.1, 0.2]),
        ([2, 3, 5], False, [0, 0.1, 0.2]),
        ([10, 11, 13], True, [0, 1, 3]),
        ([1.5, 1.75, 2.5], True, [0, 0.25, 1]),
        ([0, 1, 2], None, [0, 0.1, 0.2]),
        ([0, 2, 4], None, [0, 2, 4]),
        ([4], False, [0]),
    ],
)
def test_frames_that_have_positions_for_times_are_a_tenth_of_a_second_apart(
    timestamps: list[float], timed: bool | None, times: list[float]
) -> None:
    np.testing.assert_allclose(_times(np.array(timestamps, np.float64), timed), times)


def masked_result(folder: Path) -> Reconstruction:
    """Two frames of which a mask drops the left third."""
    result = write_room_result(folder, count=2)
    document = json.loads((result.folder / "cameras.json").read_text())
    for index, frame in enumerate(document["frames"]):
        frame["masked"] = 0.33
        depth, confidence = result.depth_and_confidence(index)
        left = np.arange(depth.shape[1]) < depth.shape[1] // 3
        write_depth(depth_file(result.folder, frame["name"]), np.where(left, 0, depth), np.where(left, 0, confidence))
    (result.folder / "cameras.json").write_text(json.dumps(document))
    return Reconstruction.open(result.folder)


# What is said and refused


def test_the_results_own_files_are_never_replaced(tmp_path: Path) -> None:
    result = write_room_result(tmp_path, count=2)
    before = contents(result.folder)
    with pytest.raises(InputError, match="is the result itself, or lies among its own files"):
        export(result, ["ply"], result.folder, point_filter=FEW_POINTS, overwrite=True, progress=False)
    for inside in ("depth", "images/scene"):
        with pytest.raises(InputError, match="is the result itself, or lies among its own files"):
            export(result, ["ply"], result.folder / inside, point_filter=FEW_POINTS, progress=False)
    assert contents(result.folder) == before
    (made,) = export(result, ["ply"], result.folder / "exports" / "few", point_filter=FEW_POINTS, progress=False)
    assert made.is_file()


def test_a_library_that_does_not_load_is_told_from_one_that_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "trimesh").mkdir()
    (tmp_path / "trimesh" / "__init__.py").write_text("raise ImportError('libX.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "trimesh", raising=False)
    importlib.invalidate_caches()
    with pytest.raises(
        MissingPackage, match=r"trimesh, which is installed and does not load \(libX\.so\.1: .*\): inst"
    ):
        library("trimesh")


def test_a_folder_of_a_run_that_has_not_ended_is_called_so(tmp_path: Path) -> None:
    (tmp_path / "walk.partial").mkdir()
    for name in ("walk", "walk.partial"):
        with pytest.raises(InputError, match=r"walk\.partial is what a run has left .*: the same command goes on"):
            Reconstruction.open(tmp_path / name)
    with pytest.raises(InputError, match=r"expected the output of `logvggt reconstruct`$"):
        Reconstruction.open(tmp_path / "other")


def test_another_decoders_name_does_not_make_a_source_another(tmp_path: Path) -> None:
    result = write_room_result(tmp_path, count=2)
    document = json.loads((result.folder / "cameras.json").read_text())
    document["source"]["fingerprint"] += " OtherDecoder"
    (result.folder / "cameras.json").write_text(json.dumps(document))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (folder,) = export(Reconstruction.open(result.folder), ["nerfstudio"], point_filter=FEW_POINTS, progress=False)
    frame = json.loads((folder / "transforms.json").read_text())["frames"][0]
    assert (frame["h"], frame["w"]) == result.image_size


def test_without_its_source_a_result_gives_its_own_pictures_and_says_so(tmp_path: Path) -> None:
    result = write_room_result(tmp_path, count=2)
    (tmp_path / "source" / "view 1.png").unlink()
    with pytest.warns(UserWarning, match=r"result's own, 56 x 42 pixels.*has changed since"):
        (folder,) = export(result, ["nerfstudio"], point_filter=FEW_POINTS, progress=False)
    frame = json.loads((folder / "transforms.json").read_text())["frames"][1]
    assert (frame["h"], frame["w"]) == result.depth_size
    assert frame["cx"] == result.depth_intrinsics[1, 0, 2] + 0.5
    with Image.open(folder / frame["file_path"]) as picture:
        assert_is_picture(np.asarray(picture), result.image(1))
    shutil.rmtree(tmp_path / "source")
    with pytest.warns(UserWarning, match=r"source.*does not exist"):
        export(result, ["nerfstudio"], point_filter=FEW_POINTS, overwrite=True, progress=False)


def test_too_small_a_disk_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result, out = write_room_result(tmp_path, count=2), tmp_path / "out"
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=20_000))
    for names in (["tum", "depth-png"], ["tum", "nerfstudio"]):
        with pytest.raises(DiskError, match=r"out: needs about 0\.0 MB, 0\.0 MB are free.*fewer formats"):
            export(result, names, out, point_filter=FEW_POINTS, progress=False)
    assert not out.exists()
    export(result, ["tum"], out, progress=False)
    # The pictures that a result keeps are smaller than those of its source.
    shutil.rmtree(tmp_path / "source")
    with pytest.warns(UserWarning, match="the result's own"):
        export(result, ["nerfstudio"], out, point_filter=FEW_POINTS, progress=False)


@pytest.mark.parametrize("name", ["nerfstudio", "depth-png", "depth-exr", "depth-npz", "rosbag2"])
def test_pictures_and_depth_take_what_is_estimated(tmp_path: Path, name: str) -> None:
    if (needs := EXPORTERS[name].needs) is not None:
        pytest.importorskip(needs, reason=f"{needs} is not installed")
    result = write_room_result(tmp_path, count=1, size=(168, 224), image_size=(360, 480))
    (path,) = export(result, [name], tmp_path / "out", point_filter=FEW_POINTS, progress=False)
    written = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    # A bag is a data base, and smooth rooms compress better than photographs.
    assert 0.2 * frame_bytes([name], result.image_size, result.image_size) < written
    assert written < 1.2 * frame_bytes([name], result.image_size, result.image_size) + 150_000


def test_a_single_format_may_be_given_by_its_name(result: Reconstruction, tmp_path: Path) -> None:
    assert export(result, "tum", tmp_path, progress=False) == [tmp_path / "tum.txt"]
    with pytest.raises(InputError, match="there is no format 'tun': choose among"):
        export(result, "tun", tmp_path, progress=False)


def test_what_exists_is_refused_before_anything_is_written(result: Reconstruction, tmp_path: Path) -> None:
    (tmp_path / "kitti.txt").write_text("mine")
    with pytest.raises(OutputExists, match=r"kitti\.txt exists: .*--overwrite"):
        export(result, ["tum", "kitti"], tmp_path, progress=False)
    assert {path.name for path in tmp_path.iterdir()} == {"kitti.txt"}
    export(result, ["tum", "kitti"], tmp_path, overwrite=True, progress=False)
    assert (tmp_path / "kitti.txt").read_text() != "mine"
    (tmp_path / "depth-npz").mkdir()
    (tmp_path / "depth-npz" / "thesis.txt").write_text("mine")
    with pytest.raises(OutputExists, match=r"no depth\.json, so it is no earlier result"):
        export(result, ["depth-npz"], tmp_path, overwrite=True, progress=False)
    assert (tmp_path / "depth-npz" / "thesis.txt").exists()


@pytest.mark.parametrize(
    ("name", "needed", "extra"),
    [
        ("colmap", "pycolmap", "colmap"),
        ("glb", "trimesh", "formats"),
        ("rosbag2", "rosbags", "formats"),
        ("depth-exr", "OpenEXR", "formats"),
    ],
)
def test_a_missing_library_is_named_with_the_line_that_brings_it(
    result: Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, needed: str, extra: str
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda module: None if module == needed else find(module))
    with pytest.raises(MissingPackage, match=rf'{needed}.*pip install "logvggt-jax\[{extra}\]"') as caught:
        export(result, ["tum", name], tmp_path, progress=False)
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


def test_an_export_that_fails_leaves_nothing_and_the_result_as_it_was(tmp_path: Path) -> None:
    result = write_room_result(tmp_path, count=3)
    depth = result.folder / "depth" / "view 2.npz"
    depth.write_bytes(depth.read_bytes()[:100])
    before = contents(result.folder)
    for name in ("colmap", "glb", "depth-npz", "depth-png", "rosbag2", "nerfstudio"):
        with pytest.raises(InputError, match=r"view 2\.npz"):
            export(result, [name], tmp_path / "out", progress=False)
    assert not list((tmp_path / "out").iterdir())
    assert contents(result.folder) == before


def test_no_such_format(result: Reconstruction, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no format 'obj': choose among colmap, colmap-text"):
        export(result, ["obj"], tmp_path)


@pytest.fixture
def no_warning() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def test_a_result_of_one_frame_has_every_export(tmp_path: Path, no_warning: None) -> None:
    result = write_room_result(tmp_path, count=1)
    written = export(result, list(EXPORTERS), tmp_path / "out", point_filter=FEW_POINTS, progress=False)
    assert all(path.exists() for path in written)
    trimesh = pytest.importorskip("trimesh", reason="extra `formats` is not installed")
    assert len(trimesh.load(tmp_path / "out" / "scene.glb").geometry["points"].vertices) == 600


def test_names_of_files_have_no_blanks_and_stay_apart() -> None:
    assert file_stems(["a b", "a_b", "a/b", "ok-1.2", "école", "a\udcffb"]) == [
        "a_b-2",
        "a_b",
        "a_b-3",
        "ok-1.2",
        "école",
        "a_b-4",
    ]


def test_names_of_files_differ_where_capitals_do_not_count() -> None:
    assert file_stems(["IMG_1", "img_1", "Img 1", "img_1-2"]) == ["IMG_1", "img_1-3", "Img_1-4", "img_1-2"]
