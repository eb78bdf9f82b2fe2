"""A reconstruction on disk is what the model says of the frames, whole or absent, at constant memory."""

from __future__ import annotations

import importlib
import weakref
from pathlib import Path

import cv2
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.data.feeding.transforms import preprocess
from logvggt_jax.geometry import decode_poses, unproject
from logvggt_jax.reconstruction.cameras_file import read_cameras
from logvggt_jax.reconstruction.depth_files import as_stored, read_depth
from logvggt_jax.reconstruction.exporters.tum import read_trajectory
from logvggt_jax.reconstruction.point_cloud import PointFilter, count_points
from logvggt_jax.reconstruction.reconstruct import reconstruct
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.room_sequence import write_room_sequence
from logvggt_jax.reconstruction.sources import open_source
from logvggt_jax.streaming.chunks import ChunkPlan
from logvggt_jax.streaming.offline import predict_plain
from logvggt_jax.streaming.windows import StreamSession

# The package exports a function of the module's name.
reconstruct_module = importlib.import_module("logvggt_jax.reconstruction.reconstruct")

COUNT, LONGER_EDGE = 7, 42


@pytest.fixture(scope="module")
def model(small_config: ModelConfig) -> LogVGGT:
    return LogVGGT(small_config)


@pytest.fixture(scope="module")
def variables(small_variables: dict) -> dict:
    """The small model with a field of view of about a radian whatever it sees."""
    head = dict(small_variables["params"]["camera_head"])
    branch = dict(head["pose_branch"])
    last = branch["fc2"]
    bias = np.array(last["bias"])
    bias[7:] = 0.25
    kernel = np.array(last["kernel"])
    kernel[:, 7:] = 0
    head["pose_branch"] = {**branch, "fc2": {**last, "bias": bias, "kernel": kernel}}
    return {"params": {**small_variables["params"], "camera_head": head}}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source") / "room"
    return write_room_sequence(folder, num_frames=COUNT, image_size=(56, 84), progress=False)


@pytest.fixture(scope="module")
def result(model: LogVGGT, variables: dict, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    return reconstruct(
        room,
        tmp_path_factory.mktemp("out") / "room",
        model=model,
        variables=variables,
        longer_edge=LONGER_EDGE,
        point_filter=PointFilter(confidence_percentile=0, edge_threshold=None, max_points=None),
        num_previews=3,
        progress=False,
    )


@pytest.fixture(scope="module")
def expected(model: LogVGGT, variables: dict, room: Path) -> dict[str, np.ndarray]:
    images, transform = preprocess([frame.image for frame in open_source(room)], longer_edge=LONGER_EDGE)
    session = StreamSession(model, variables)
    results = session.push(np.rint(images * 255).astype(np.uint8)) + session.close()
    extrinsics, intrinsics = decode_poses(session.cameras().pose_encoding, transform.size)
    stored = [as_stored(r.depth, r.confidence) for r in results]
    return {
        "images": np.rint(images * 255).astype(np.uint8),
        "depth": np.stack([depth for depth, _ in stored]),
        "confidence": np.stack([confidence for _, confidence in stored]),
        "extrinsics": extrinsics,
        "intrinsics": intrinsics,
        "original": transform.intrinsics_to_original(intrinsics),
    }


def test_result_says_where_everything_lies(result: Reconstruction) -> None:
    assert sorted(path.name for path in result.folder.iterdir()) == sorted(
        ["cameras.json", "trajectory.txt", "points.ply", "depth", "images", "previews"]
    )
    assert result.num_frames == COUNT
    assert result.depth_size == (28, 42)
    for name in ("cameras.json", "trajectory.txt", "points.ply", "depth", "images", "previews"):
        assert str(result.folder / name) in result.summary()
    assert len(list((result.folder / "previews").glob("*.png"))) == 3
    picture = cv2.imread(str(result.folder / "previews" / "frame-000003.png"))
    assert picture.shape == (28, 84, 3)


def test_depth_files_hold_the_models_depth(result: Reconstruction, expected: dict) -> None:
    files = sorted((result.folder / "depth").iterdir())
    assert [file.name for file in files] == [f"frame-{index:06d}.npz" for index in range(COUNT)]
    for index, file in enumerate(files):
        depth, confidence = read_depth(file)
        np.testing.assert_allclose(depth, expected["depth"][index], rtol=1e-3)
        np.testing.assert_allclose(confidence, expected["confidence"][index], rtol=1e-3)


def test_cameras_and_trajectory_agree(result: Reconstruction, expected: dict) -> None:
    cameras = read_cameras(result.folder / "cameras.json")
    assert cameras["image_size"] == [56, 84]
    assert cameras["depth_size"] == [28, 42]
    for key, value in (
        ("extrinsics", expected["extrinsics"]),
        ("depth_intrinsics", expected["intrinsics"]),
        ("intrinsics", expected["original"]),
    ):
        np.testing.assert_allclose([frame[key] for frame in cameras["frames"]], value, rtol=1e-5, atol=1e-5)
    timestamps, poses = read_trajectory(result.folder / "trajectory.txt")
    np.testing.assert_array_equal(timestamps, np.arange(COUNT))
    np.testing.assert_allclose(poses[:, :3], expected["extrinsics"], rtol=1e-4, atol=1e-4)


def test_points_are_the_depth_maps_unprojected(result: Reconstruction, expected: dict) -> None:
    points, colours = result.points()
    valid = expected["depth"] > 1e-8
    assert len(points) == result.num_points == valid.sum()
    world = unproject(expected["depth"], expected["intrinsics"], expected["extrinsics"])[valid]
    np.testing.assert_allclose(points, world, rtol=2e-3, atol=2e-3 * np.abs(world).max())
    # A few grey levels is what storing the frames as JPEG costs.
    difference = np.abs(colours.astype(int) - expected["images"][valid])
    assert difference.mean() < 2.5 and np.percentile(difference, 99) <= 8


def test_the_frames_are_kept_as_the_model_saw_them(result: Reconstruction, expected: dict) -> None:
    opened = Reconstruction.open(result.folder)
    for index in range(COUNT):
        difference = np.abs(opened.image(index).astype(int) - expected["images"][index])
        assert difference.mean() < 2.5


def test_a_video_gives_the_same_results_as_a_folder_of_its_frames(
    model: LogVGGT, variables: dict, room: Path, tmp_path: Path
) -> None:
    video, folder = tmp_path / "walk.mp4", tmp_path / "frames"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (84, 56))
    for file in sorted(room.glob("*.color.png")):
        writer.write(cv2.imread(str(file)))
    writer.release()
    folder.mkdir()
    for frame in open_source(video):
        cv2.imwrite(str(folder / f"{frame.name}.png"), frame.image[..., ::-1])
    results = [
        reconstruct(
            source,
            tmp_path / f"from-{source.name}",
            model=model,
            variables=variables,
            longer_edge=LONGER_EDGE,
            progress=False,
        )
        for source in (video, folder)
    ]
    for name in ("points.ply", "depth/frame-000006.npz", "previews/frame-000000.png"):
        first, second = ((result.folder / name).read_bytes() for result in results)
        assert first == second, name
    (times, poses), (positions, same) = (read_trajectory(result.folder / "trajectory.txt") for result in results)
    np.testing.assert_array_equal(poses, same)
    np.testing.assert_array_equal(positions, np.arange(COUNT))
    np.testing.assert_allclose(times, np.arange(COUNT) / 10, atol=1e-6)


def test_a_limit_on_points_holds(model: LogVGGT, variables: dict, room: Path, tmp_path: Path) -> None:
    limited = reconstruct(
        room,
        tmp_path / "out",
        model=model,
        variables=variables,
        longer_edge=LONGER_EDGE,
        stride=2,
        max_frames=3,
        point_filter=PointFilter(edge_threshold=None, max_points=100),
        num_previews=0,
        progress=False,
    )
    assert limited.num_frames == 3
    assert limited.num_points == 100
    assert count_points(tmp_path / "out" / "points.ply") == 100
    assert read_trajectory(tmp_path / "out" / "trajectory.txt")[0].tolist() == [0, 2, 4]


@pytest.mark.parametrize("broken", [1, 6])
def test_a_broken_frame_leaves_nothing_behind(
    model: LogVGGT, variables: dict, room: Path, tmp_path: Path, broken: int
) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for file in room.glob("*.color.png"):
        (source / file.name).write_bytes(file.read_bytes())
    path = source / f"frame-{broken:06d}.color.png"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ValueError, match=path.name):
        reconstruct(
            source,
            tmp_path / "out",
            model=model,
            variables=variables,
            longer_edge=LONGER_EDGE,
            progress=False,
        )
    assert [entry.name for entry in tmp_path.iterdir()] == ["source"]


def test_few_frames_are_alive_at_a_time(
    model: LogVGGT, variables: dict, room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many frames pass through, no more than a window of them is held."""
    made: list[weakref.ref] = []
    alive: list[int] = []
    image, transform = preprocess([next(iter(open_source(room))).image], longer_edge=LONGER_EDGE)

    def pictures(source: object, longer_edge: int):
        for index in range(40):
            frame = np.rint(image[0] * 255).astype(np.uint8)
            made.append(weakref.ref(frame))
            alive.append(sum(reference() is not None for reference in made))
            yield reconstruct_module._Picture(f"frame-{index:06d}", index, frame, transform)

    monkeypatch.setattr(reconstruct_module, "_pictures", pictures)
    reconstruct(room, tmp_path / "out", model=model, variables=variables, longer_edge=LONGER_EDGE, progress=False)
    assert len(made) == 40  # once each
    # A window, the frame at hand and the one read ahead.
    assert max(alive) <= 6


def test_chunks_of_the_whole_sequence_are_plain_vggt(
    model: LogVGGT, variables: dict, room: Path, tmp_path: Path, expected: dict
) -> None:
    result = reconstruct(
        room,
        tmp_path / "out",
        model=model,
        variables=variables,
        chunks=ChunkPlan(COUNT, 3),
        longer_edge=LONGER_EDGE,
        num_previews=0,
        progress=False,
    )
    plain = predict_plain(model, variables, expected["images"])
    cameras = read_cameras(result.folder / "cameras.json")
    np.testing.assert_allclose([f["extrinsics"] for f in cameras["frames"]], plain.extrinsics, rtol=1e-5, atol=1e-5)
    depth, _ = read_depth(result.folder / "depth" / "frame-000006.npz")
    np.testing.assert_allclose(depth, as_stored(plain.depth[6], plain.depth_confidence[6])[0], rtol=1e-3)


def test_bad_arguments_are_named(
    model: LogVGGT, variables: dict, room: Path, tmp_path: Path, result: Reconstruction
) -> None:
    def run(source: Path = room, output: Path = tmp_path / "out", **options: object) -> None:
        reconstruct(
            source,
            output,
            model=model,
            variables=variables,
            progress=False,
            **{"longer_edge": LONGER_EDGE, **options},  # type: ignore[arg-type]
        )

    with pytest.raises(ValueError, match="longer_edge must be a positive multiple of 14"):
        run(longer_edge=50)
    with pytest.raises(FileExistsError, match="--overwrite"):
        run(output=result.folder)
    with pytest.raises(ValueError, match="contains the source"):
        run(output=room.parent, overwrite=True)
    with pytest.raises(ValueError, match="num_previews"):
        run(num_previews=-1)
    assert list(tmp_path.iterdir()) == []
    assert (result.folder / "cameras.json").is_file()


def test_no_field_of_view_is_reported_and_replaced(model: LogVGGT, variables: dict, room: Path, tmp_path: Path) -> None:
    head = variables["params"]["camera_head"]
    last = head["pose_branch"]["fc2"]
    blind = {**last, "bias": np.array(last["bias"]) - 1.0}
    params = {
        **variables["params"],
        "camera_head": {**head, "pose_branch": {**head["pose_branch"], "fc2": blind}},
    }
    with pytest.warns(UserWarning, match="3 of 3 frames have no field of view"):
        reconstruct(
            room,
            tmp_path / "out",
            model=model,
            variables={"params": params},
            longer_edge=LONGER_EDGE,
            max_frames=3,
            progress=False,
        )
    cameras = read_cameras(tmp_path / "out" / "cameras.json")
    assert all(np.isfinite(frame["intrinsics"]).all() for frame in cameras["frames"])
