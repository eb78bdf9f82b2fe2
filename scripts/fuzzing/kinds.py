"""The kinds of input that people have, with the entry that reads each and what its result has to be.

Valid inputs are those of the tests: the layouts of `tests/data`, the result folder of `tests/reconstruction`, the
checkpoints of `tests/weights`. Imports are made where they are needed: a data set needs no JAX.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import json
import shutil
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fuzzing.cases import Kind, Nonsense

_FRAMES = 6
_KEYS = [f"{number:024x}" for number in range(6)]
_ENVIRONMENT = {"versions": {"jax": "0.0.0"}, "commit": "none", "device": "none"}


def _expect(condition: Any, complaint: str) -> None:
    if not condition:
        raise Nonsense(complaint)


def _expect_finite(what: str, *arrays: Any) -> None:
    """Finite in float32, in which models and viewers take them."""
    _expect(all(np.isfinite(np.asarray(array, np.float32)).all() for array in arrays), f"{what} are not finite")


def _layout(name: str) -> Any:
    if name in ("tum", "bonn"):
        return next(each for each in importlib.import_module("layouts.timed").LAYOUTS if each.reader.name == name)
    return importlib.import_module(f"layouts.{name}").LAYOUT


def _write_dataset(name: str, root: Path) -> None:
    layout = _layout(name)
    layout.write(root, layout.views)


def _read_dataset(name: str, root: Path, output: Path) -> None:
    from logvggt_jax.data import check_frames, open_dataset
    from logvggt_jax.errors import InputError

    dataset = open_dataset(name, root)
    for sequence in dataset.sequences:
        frames = dataset.read(sequence, range(dataset.num_frames(sequence)))
        try:
            check_frames(frames, sequence, poses=False)
        except InputError as error:
            raise Nonsense(f"read without complaint: {error}") from error


def _write_packed(root: Path) -> None:
    from logvggt_jax.data.packed.pack import pack

    _write_dataset("seven_scenes", root / "originals")
    pack("seven_scenes", root / "originals", root / "packed")
    shutil.rmtree(root / "originals")


def _read_packed(root: Path, output: Path) -> None:
    _read_dataset("seven_scenes", root / "packed", output)


def _pictures() -> np.ndarray:
    """[N, 48, 64, 3] uint8, smooth, no two alike."""
    v, u = np.mgrid[0:48, 0:64]
    return np.stack([np.stack([3 * u, 5 * v, np.full_like(u, 40 * n)], -1) for n in range(_FRAMES)]).astype(np.uint8)


def _write_images(root: Path) -> None:
    from PIL import Image

    for number, picture in enumerate(_pictures()):
        Image.fromarray(picture).save(root / f"img{number}.{'png' if number % 2 else 'jpg'}")


def _write_video(root: Path) -> None:
    import cv2

    writer = cv2.VideoWriter(str(root / "walk.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, (64, 48))
    for picture in _pictures():
        writer.write(picture)
    writer.release()


def _read_video_by_opencv(root: Path, output: Path) -> None:
    """As where PyAV is not installed."""
    known = sys.modules.pop("av", None)
    sys.modules["av"] = None  # type: ignore[assignment]
    try:
        _read_source("walk.mp4", root, output)
    finally:
        del sys.modules["av"]
        if known is not None:
            sys.modules["av"] = known


def _read_source(name: str, root: Path, output: Path) -> None:
    from logvggt_jax.reconstruction.sources import open_source

    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        source = open_source(root / name)
        images = [frame.image for frame in source]
    _expect(images, "no frame and no error")
    shapes = {image.shape for image in images}
    _expect(len(shapes) == 1 and images[0].dtype == np.uint8 and images[0].ndim == 3, f"frames have shapes {shapes}")
    said = source.skipped or source.notes or warned
    # Nothing tells that a folder had a picture before its first or after its last.
    numbered = (file.stem.removeprefix("img") for file in root.glob("img*"))
    numbers = [int(number) for number in numbered if number.isdecimal()] or range(_FRAMES)
    expected = max(numbers) - min(numbers) + 1
    _expect(len(images) >= expected or said, f"{len(images)} of {expected} frames, and nothing said")


def _write_result(root: Path) -> None:
    importlib.import_module("result_folder").write_result(root)


def _read_result(root: Path, output: Path) -> None:
    from logvggt_jax.geometry import camera_centres, is_rotation, matrix_to_quaternion
    from logvggt_jax.reconstruction.exporters import export
    from logvggt_jax.reconstruction.exporters.tum import read_trajectory
    from logvggt_jax.reconstruction.points.cloud_file import read_points
    from logvggt_jax.reconstruction.result import Reconstruction

    result = Reconstruction.open(root)
    # What the viewer shows.
    points, colours = result.points()
    _expect(points.shape == colours.shape and points.ndim == 2, f"points have shape {points.shape}")
    rotations = np.swapaxes(result.extrinsics[:, :3, :3], -1, -2)
    _expect(is_rotation(rotations).all(), "rotations are none")
    _expect_finite("points and cameras", points, camera_centres(result.extrinsics), matrix_to_quaternion(rotations))
    _expect_finite("intrinsics", result.intrinsics, 1 / result.intrinsics[:, (0, 1), (0, 1)])
    _expect(np.isfinite(result.timestamps).all(), "time stamps are not finite")
    for index in range(result.num_frames):
        maps = result.depth_and_confidence(index)
        _expect(all(each.shape == result.depth_size for each in maps), "depth has another size than cameras")
    # What is written from it can be read.
    export(result, ["ply", "tum", "kitti", "euroc", "nerfstudio", "depth-png", "depth-npz"], output, progress=False)
    read_points(output / "points.ply")
    read_trajectory(output / "tum.txt")


def _write_trajectory(root: Path) -> None:
    from logvggt_jax.reconstruction import write_trajectory

    extrinsics = np.tile(np.eye(4)[:3], (10, 1, 1))
    extrinsics[:, :, 3] = np.random.default_rng(0).normal(size=(10, 3))
    write_trajectory(root / "trajectory.txt", np.arange(10) / 30, extrinsics)


def _read_trajectory(root: Path, output: Path) -> None:
    from logvggt_jax.geometry import is_rotation
    from logvggt_jax.reconstruction import read_trajectory

    timestamps, extrinsics = read_trajectory(root / "trajectory.txt")
    _expect(np.isfinite(timestamps).all(), "time stamps are not finite")
    _expect_finite("poses", extrinsics)
    _expect(is_rotation(extrinsics[:, :3, :3]).all(), "rotations are none")


def _write_transforms(root: Path) -> None:
    frame = {"w": 64, "h": 48, "fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0}
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(6, 3))
    frames = [{"file_path": f"images/{i}.jpg", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    (root / "transforms.json").write_text(json.dumps({**frame, "frames": frames}))


def _read_transforms(root: Path, output: Path) -> None:
    from logvggt_jax.geometry import is_rotation
    from logvggt_jax.reconstruction.fusion.pose_files import read_poses

    poses = read_poses(root / "transforms.json")
    extrinsics = np.stack([pose.extrinsics for pose in poses])
    _expect_finite("poses", extrinsics, *(pose.intrinsics for pose in poses if pose.intrinsics is not None))
    _expect(is_rotation(extrinsics[:, :3, :3]).all(), "rotations are none")


def _record(number: int) -> dict[str, Any]:
    return {
        "benchmark": "rooms-clips-4",
        "sequence": f"room {number}",
        "frames": 4,
        "method": "static camera",
        "frames_used": 4,
        "indices": [0, 2, 4, 6],
        "metrics": {"abs_rel": 0.125 * number, "valid_pixels": 1176.0, "ate": None},
        "failures": {},
        "figures": [f"figures/room_{number}_frames_depth.png"],
    }


def _write_evaluation(root: Path) -> None:
    from logvggt_jax.evaluation.records import RECORDS_FILE, ClipRecords

    records = ClipRecords(root / RECORDS_FILE, _KEYS, _ENVIRONMENT)
    for number, key in enumerate(_KEYS):
        records.add(key, _record(number))


def _read_evaluation(root: Path, output: Path) -> None:
    from logvggt_jax.evaluation.records import RECORDS_FILE, ClipRecords

    records = ClipRecords(root / RECORDS_FILE, _KEYS, _ENVIRONMENT)
    for number, key in enumerate(_KEYS):
        if key in records:
            found = {name: records[key].get(name) for name in _record(number)}
            _expect(found == _record(number), f"a damaged record counts: {found}")
        else:
            records.add(key, _record(number))
    # Measured again what was lost, the evaluation is whole.
    records.keep_asked()
    again = ClipRecords(root / RECORDS_FILE, _KEYS, _ENVIRONMENT)
    _expect(all(key in again for key in _KEYS), "the evaluation does not go on")


@functools.cache
def _vggt() -> tuple[Any, dict[str, np.ndarray]]:
    """Sizes of a small VGGT and its state dict."""
    torch_files = importlib.import_module("torch_files")
    config = torch_files.small_vggt_config()
    return config, torch_files.random_state_dict(config)


@functools.cache
def _small_model() -> tuple[Any, Any]:
    """Sizes and parameters of a small model."""
    from logvggt_jax.weights.vggt import params_from_vggt

    config, state_dict = _vggt()
    config = dataclasses.replace(config, point_head=None)  # Orbax takes its time for every leaf
    return config, params_from_vggt(state_dict, config)[0]


def _leaves(tree: Any) -> Iterator[np.ndarray]:
    import jax

    return (np.asarray(leaf) for leaf in jax.tree.leaves(tree))


def _write_safetensors(root: Path) -> None:
    from safetensors.numpy import save_file

    save_file(_vggt()[1], root / "model.safetensors")


def _write_torch_zip(root: Path) -> None:
    importlib.import_module("torch_files").write_torch_file(root / "model.pt", _vggt()[1])


def _read_checkpoint(name: str, root: Path, output: Path) -> None:
    from logvggt_jax.weights import from_pretrained

    _, variables = from_pretrained(root / name)
    _expect_finite("parameters", *_leaves(variables))


def _write_model(rounded: bool, root: Path) -> None:
    from logvggt_jax.weights import Provenance
    from logvggt_jax.weights.checkpoints import save_model, save_rounded_model

    config, params = _small_model()
    save = save_rounded_model if rounded else save_model
    save(root / "model", config, params, Provenance("windows", 518, "none", "made for damage"))


def _read_model(rounded: bool, root: Path, output: Path) -> None:
    from logvggt_jax.weights import load_model
    from logvggt_jax.weights.checkpoints import read_provenance

    config, params = _small_model()
    model, variables = load_model(root / "model")
    _expect(model.config == config, f"loaded as another model: {model.config}")
    # float16 changes these by less than bfloat16 does.
    stored = (leaf.astype(np.float16).astype(np.float32) if rounded else leaf for leaf in _leaves(params))
    same = all(np.array_equal(a, b) for a, b in zip(_leaves(variables["params"]), stored, strict=True))
    _expect(same, "loaded with other parameters")
    provenance = read_provenance(root / "model")
    _expect(provenance.trained_for == "windows" and provenance.longer_edge == 518, f"loaded as {provenance}")


def _datasets() -> list[str]:
    from logvggt_jax.data.registry import READERS

    return [name for name, reader in READERS.items() if reader.needs_root]


KINDS = (
    *(
        Kind(name, functools.partial(_write_dataset, name), functools.partial(_read_dataset, name))
        for name in _datasets()
    ),
    Kind("packed", _write_packed, _read_packed),
    Kind("photographs", _write_images, functools.partial(_read_source, "")),
    Kind("video", _write_video, functools.partial(_read_source, "walk.mp4")),
    Kind("video by opencv", _write_video, _read_video_by_opencv),
    Kind("safetensors", _write_safetensors, functools.partial(_read_checkpoint, "model.safetensors")),
    Kind("torch", _write_torch_zip, functools.partial(_read_checkpoint, "model.pt")),
    Kind("model", functools.partial(_write_model, False), functools.partial(_read_model, False)),
    Kind("shipped", functools.partial(_write_model, True), functools.partial(_read_model, True)),
    Kind("result", _write_result, _read_result),
    Kind("trajectory", _write_trajectory, _read_trajectory),
    Kind("transforms", _write_transforms, _read_transforms),
    Kind("evaluation", _write_evaluation, _read_evaluation),
)
"""All kinds, in the order in which cases take turns."""
