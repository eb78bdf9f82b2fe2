"""A reconstruction on disk is what the model says of the frames, whole or absent, at constant memory."""

from __future__ import annotations

import shutil
import threading
import weakref
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base
from recorder import Recorder, reconstruct_recorded

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.data.feeding.transforms import preprocess, resize
from logvggt_jax.errors import DiskError, InputError
from logvggt_jax.geometry import decode_poses, unproject
from logvggt_jax.reconstruction import frame_writer, masking
from logvggt_jax.reconstruction.cameras_file import read_cameras
from logvggt_jax.reconstruction.depth_files import read_depth
from logvggt_jax.reconstruction.exporters.tum import read_trajectory
from logvggt_jax.reconstruction.points.cloud_file import count_points
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.reconstruct import reconstruct
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.room_sequence import write_room_sequence
from logvggt_jax.reconstruction.sources import open_source
from logvggt_jax.streaming.chunks import ChunkPlan
from logvggt_jax.streaming.offline import predict_plain
from logvggt_jax.streaming.windows import StreamSession

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


def as_stored(values: np.ndarray) -> np.ndarray:
    """Values as files keep them: float16, within its range."""
    return np.clip(values, -65504, 65504).astype(np.float16).astype(np.float32)


@pytest.fixture(scope="module")
def expected(model: LogVGGT, variables: dict, room: Path) -> dict[str, np.ndarray]:
    images, transform = preprocess([frame.image for frame in open_source(room)], longer_edge=LONGER_EDGE)
    session = StreamSession(model, variables)
    results = session.push(np.rint(images * 255).astype(np.uint8)) + session.close()
    extrinsics, intrinsics = decode_poses(session.cameras().pose_encoding, transform.size)
    return {
        "images": np.rint(images * 255).astype(np.uint8),
        "depth": as_stored(np.stack([result.depth for result in results])),
        "confidence": as_stored(np.stack([result.confidence for result in results])),
        "extrinsics": extrinsics,
        "intrinsics": intrinsics,
        "original": transform.intrinsics_to_original(intrinsics),
    }


def test_result_says_where_everything_lies(result: Reconstruction) -> None:
    assert sorted(path.name for path in result.folder.iterdir()) == sorted(
        ["cameras.json", "trajectory.txt", "points.ply", "depth", "images", "previews", "health.json", "health.html"]
    )
    assert result.num_frames == COUNT
    assert result.depth_size == (28, 42)
    for name in ("cameras.json", "trajectory.txt", "points.ply", "depth", "images", "previews"):
        assert str(result.folder / name) in result.summary()
    assert len(list((result.folder / "previews").glob("*.png"))) == 3
    picture = cv2.imread(str(result.folder / "previews" / "frame-000003.png"))
    assert picture.shape[1] >= 2 * 512, "image and depth, at a size one can see"


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
        open_source(room, stride=2, max_frames=3),
        tmp_path / "out",
        model=model,
        variables=variables,
        longer_edge=LONGER_EDGE,
        point_filter=PointFilter(edge_threshold=None, max_points=100),
        num_previews=0,
        progress=False,
    )
    assert limited.num_frames == 3
    assert limited.num_points == 100
    assert count_points(tmp_path / "out" / "points.ply") == 100
    assert read_trajectory(tmp_path / "out" / "trajectory.txt")[0].tolist() == [0, 2, 4]


def test_a_source_that_breaks_off_before_anything_is_final_leaves_nothing_behind(
    model: LogVGGT, variables: dict, room: Path, tmp_path: Path
) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for file in room.glob("*.color.png"):
        (source / file.name).write_bytes(file.read_bytes())
    path = source / "frame-000001.color.png"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ValueError, match=path.name):
        reconstruct(
            open_source(source, strict=True),
            tmp_path / "out",
            model=model,
            variables=variables,
            longer_edge=LONGER_EDGE,
            progress=False,
        )
    assert [entry.name for entry in tmp_path.iterdir()] == ["source"]


@pytest.fixture
def walk(room: Path, tmp_path: Path) -> Path:
    """Forty frames of a folder."""
    folder = tmp_path / "walk"
    folder.mkdir()
    contents = [file.read_bytes() for file in sorted(room.glob("*.color.png"))]
    for index in range(40):
        (folder / f"{index:03d}.png").write_bytes(contents[index % COUNT])
    return folder


def test_the_number_of_workers_changes_no_byte(walk: Path, tmp_path: Path) -> None:
    thinned = PointFilter(max_points=5000)
    written = {}
    for workers in (1, 4):
        predictor = Recorder()
        options = {"point_filter": thinned, "num_previews": 8, "progress": False, "workers": workers}
        result = reconstruct_recorded(predictor, walk, tmp_path / f"{workers}", **options)
        assert predictor.threads == {threading.get_ident()}
        files = sorted(path for path in result.folder.rglob("*") if path.is_file())
        assert result.num_points == 5000 and len(files) == 40 + 40 + 8 + 5
        written[workers] = {file.relative_to(result.folder): file for file in files}
    assert written[1].keys() == written[4].keys()
    for name, file in written[1].items():
        assert file.read_bytes() == written[4][name].read_bytes(), name


@pytest.mark.parametrize("written", ["write_depth", "write_picture"])
def test_a_full_disk_stops_the_run_with_its_own_error(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: str
) -> None:
    """What a worker cannot write is raised where frames are fed, long before the end, and nothing is left."""
    original = getattr(frame_writer, written)

    def failing(path: Path, *arrays: np.ndarray) -> object:
        if path.stem == "003":
            raise DiskError(f"{path}: No space left on device")
        return original(path, *arrays)

    monkeypatch.setattr(frame_writer, written, failing)
    predictor = Recorder()
    with pytest.raises(DiskError, match=r"003\.\w+: No space left"):
        reconstruct_recorded(predictor, walk, tmp_path / "out", progress=False, workers=1)
    assert predictor.num_frames < 30
    assert [entry.name for entry in tmp_path.iterdir()] == ["walk"]


def test_the_focal_length_of_the_camera_is_shown_beside_the_predicted_one(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = 36  # as wide as the film: focal length = width
    for index in range(4):
        Image.new("RGB", (84, 56), (index, 0, 0)).save(folder / f"{index}.jpg", exif=exif)
    result = reconstruct_recorded(Recorder(), folder, tmp_path / "out", progress=False)
    noted = Reconstruction.open(result.folder).noted_focal_length
    assert noted == pytest.approx(84, rel=0.05)
    predicted = float(np.median(result.intrinsics[:, 0, 0]))
    assert f"focal length: {predicted:.0f} pixels in the result, {noted:.0f} by the camera's EXIF" in result.summary()


@pytest.mark.parametrize("terminal", ["0", "1"])
def test_one_bar_on_standard_error_if_that_is_a_terminal(
    walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, terminal: str
) -> None:
    monkeypatch.setenv("TTY_COMPATIBLE", terminal)
    reconstruct_recorded(Recorder(), walk, tmp_path / "out", workers=2)
    shown = capsys.readouterr()
    assert shown.out == ""
    if terminal == "0":
        assert shown.err == ""
    else:
        assert "Points" in shown.err and "40/40" in shown.err
        assert shown.err.count("\n") == 1  # drawn over and over on one line


def test_each_frame_is_resized_once_and_few_are_alive(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many frames pass through, no more than those at hand and a few ahead are held."""
    made: list[weakref.ref] = []
    alive: list[int] = []

    def watched(frame: np.ndarray, *, longer_edge: int):
        image, transform = resize(frame, longer_edge=longer_edge)
        image = image.copy()
        made.append(weakref.ref(image))
        alive.append(sum(reference() is not None for reference in made))
        return image, transform

    monkeypatch.setattr(masking, "resize", watched)
    reconstruct_recorded(Recorder(), walk, tmp_path / "out", progress=False, workers=2)
    assert len(made) == 40
    # Six ahead, two in the predictor, one in either worker.
    assert max(alive) <= 10


def test_chunks_of_the_whole_sequence_are_plain_vggt(
    model: LogVGGT, variables: dict, room: Path, tmp_path: Path, expected: dict
) -> None:
    # Four frames, as many as in other tests, with which the program is shared.
    result = reconstruct(
        open_source(room, max_frames=4),
        tmp_path / "out",
        model=model,
        variables=variables,
        method="chunks",
        settings=ChunkPlan(4, 3),
        longer_edge=LONGER_EDGE,
        num_previews=0,
        progress=False,
    )
    plain = predict_plain(model, variables, expected["images"][:4])
    cameras = read_cameras(result.folder / "cameras.json")
    np.testing.assert_allclose([f["extrinsics"] for f in cameras["frames"]], plain.extrinsics, rtol=1e-5, atol=1e-5)
    depth, _ = read_depth(result.folder / "depth" / "frame-000003.npz")
    np.testing.assert_allclose(depth, as_stored(plain.depth[3]), rtol=1e-3)


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

    with pytest.raises(ValueError, match="longer_edge must be a multiple of 14"):
        run(longer_edge=50)
    with pytest.raises(FileExistsError, match="--overwrite"):
        run(output=result.folder)
    with pytest.raises(ValueError, match="contains the source"):
        run(output=room.parent, overwrite=True)
    kept = result.folder / "previews" / "mine"
    kept.mkdir(parents=True)
    mine = [Path(shutil.copy(picture, kept)) for picture in sorted(room.glob("*.color.png"))[:3]]
    (tmp_path / "walk.txt").write_text("".join(f"{picture}\n" for picture in mine))
    (tmp_path / "links").mkdir()
    for picture in mine:
        (tmp_path / "links" / picture.name).symlink_to(picture)
    mask = Path(shutil.copy(mine[0], kept / "mask.png"))
    for source in (tmp_path / "walk.txt", tmp_path / "links", open_source(room, masks=mask)):
        with pytest.raises(InputError, match=rf"output {result.folder} contains \S*, which is read: choose another"):
            run(source, result.folder, overwrite=True)  # type: ignore[arg-type]
    kept.rename(result.folder / "mine")
    with pytest.raises(
        FileExistsError, match="not overwritten: mine in it is not of an earlier result, and would be del"
    ):
        run(output=result.folder, overwrite=True)
    trained = result.folder / "exports" / "colmap" / "trained"
    trained.parent.mkdir(parents=True)
    (result.folder / "mine").rename(trained)
    with pytest.raises(FileExistsError, match=rf"is not overwritten: {trained} is not of an export, and would be"):
        run(output=result.folder, overwrite=True)
    shutil.rmtree(result.folder / "exports")
    shutil.rmtree(tmp_path / "links")
    (tmp_path / "walk.txt").unlink()
    with pytest.raises(ValueError, match="previews must not be negative"):
        run(num_previews=-1)
    with pytest.raises(ValueError, match="workers must be at least 1"):
        run(workers=0)
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
            open_source(room, max_frames=3),
            tmp_path / "out",
            model=model,
            variables={"params": params},
            longer_edge=LONGER_EDGE,
            progress=False,
        )
    cameras = read_cameras(tmp_path / "out" / "cameras.json")
    assert all(np.isfinite(frame["intrinsics"]).all() for frame in cameras["frames"])
