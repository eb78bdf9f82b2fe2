"""The page of `make demo`: an unseen room reconstructed, eight rooms measured, a short training; pictures first.

    python scripts/demo_page.py runs/demo

Reads room/, reconstruction/, evaluation/ and training/ in that folder, writes figures/ and index.html, which holds all
of it in one file and opens in a browser without a server.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from logvggt_jax import page
from logvggt_jax.errors import InputError, MissingInput, disk_errors, one_line, printable
from logvggt_jax.evaluation.report import figures
from logvggt_jax.evaluation.report.page import table as table_part
from logvggt_jax.evaluation.report.tables import MARK, Table, benchmark_tables
from logvggt_jax.files import write_text
from logvggt_jax.frames import Frames
from logvggt_jax.geometry import NoSimilarity, camera_centres, invert, umeyama, unproject_pixels
from logvggt_jax.metrics import NotMeasurable, depth_metrics, pose_accuracy, relative_pose_errors, trajectory_errors
from logvggt_jax.metrics.trajectory import rms_radius
from logvggt_jax.reconstruction.reconstruct import Reconstruction
from logvggt_jax.reconstruction.room_sequence import read_room_sequence
from logvggt_jax.training.reporting.metrics_log import FILE_NAME, read_metrics

POINTS = 1_000_000
# Views of the room from outside, in the direction in which the camera looked on average: degrees looked down.
VIEWS = {"from behind the camera": 35.0, "from above": 90.0}


def write_page(folder: Path) -> Path:
    """Writes the figures and the page of a demo's folder; the page's path.

    Raises InputError where a part of the demo is missing or damaged.
    """
    room = read_room_sequence(folder / "room")
    result = Reconstruction.open(folder / "reconstruction")
    if result.num_frames != len(room.images) or result.depth_size != room.depth.shape[1:]:
        raise InputError(
            f"{result.folder}: {result.num_frames} frames of {result.depth_size}, the room has {len(room.images)} of "
            f"{room.depth.shape[1:]}; reconstruct {folder / 'room'} at its own size"
        )
    # Pictures take seconds: what is missing is told before they are drawn.
    measured, trained = _evaluation(folder / "evaluation"), _training(folder / "training", folder / "figures")
    parts = [
        page.paragraph(
            "LoG-VGGT saw the frames of a walk through a room, nothing else, and gave a depth map and a camera pose "
            "for each of them. It had never seen this room, which a program has drawn, so that the truth is known. "
            "The model is the one that ships with the package under the name rooms."
        ),
        *_room_pictures(room, result, folder / "figures"),
        *measured,
        *trained,
        page.heading("Walk through it"),
        page.paragraph("The same point cloud and cameras in a viewer, in the browser, until Ctrl-C:"),
        page.command(f".venv/bin/logvggt view {result.folder}"),
        page.paragraph("How the model was trained:"),
        page.command(".venv/bin/logvggt info rooms"),
    ]
    path = folder / "index.html"
    write_text(path, page.document("LoG-VGGT: a room from a walk through it", parts))
    return path


def _room_pictures(room: Frames, result: Reconstruction, folder: Path) -> list[str]:
    depth, confidence = (
        np.stack(maps) for maps in zip(*(result.depth_and_confidence(i) for i in range(result.num_frames)), strict=True)
    )
    figures.depth_panel(folder / "depth.png", room.images, room.depth, depth)
    parts = [
        page.heading("What the camera saw, and how far away it is"),
        page.figure(
            folder / "depth.png",
            "Four of the frames, the true depth, the predicted depth in the same colours (one scale for all of them), "
            "and the error: black is right, yellow is wrong by half.",
        ),
    ]
    clouds = _point_pictures(room, result, depth, confidence, folder)
    if clouds:
        parts += [
            page.heading("The room as points"),
            *(page.figure(path, f"Left what was reconstructed, right the truth, {view}.") for path, view in clouds),
            page.paragraph("Walls and ceiling that face away from the viewer are left out, so that one looks in."),
        ]
    figures.trajectory_plot(folder / "trajectory.png", result.extrinsics, room.extrinsics)
    table, sentence = _room_numbers(room, result, depth)
    return [
        *parts,
        page.heading("Where the camera went"),
        page.figure(
            folder / "trajectory.png", "The camera's path beside the true one, in the plane of its largest extent."
        ),
        page.paragraph(sentence),
        table_part(table),
    ]


def _point_pictures(
    room: Frames, result: Reconstruction, depth: np.ndarray, confidence: np.ndarray, folder: Path
) -> list[tuple[Path, str]]:
    """Pictures of the cloud with a name each; none where the prediction cannot be laid over the truth."""
    sure = np.flatnonzero((confidence >= np.percentile(confidence, 25)) & (room.depth > 0) & np.isfinite(depth))
    chosen = np.sort(np.random.default_rng(0).choice(sure, min(POINTS, len(sure)), replace=False))
    found = unproject_pixels(depth, result.depth_intrinsics, result.extrinsics, chosen)
    true = unproject_pixels(room.depth, room.intrinsics, room.extrinsics, chosen)
    try:
        found = umeyama(found, true).apply(found)
    except NoSimilarity:
        return []
    frames, pixels = np.divmod(chosen, room.depth[0].size)
    colours = room.images.reshape(len(room.images), -1, 3)[frames, pixels]
    rays = true - camera_centres(room.extrinsics.astype(np.float64))[frames]
    drawn = []
    forward = room.extrinsics[:, 2, :3].mean(0)
    yaw = float(np.degrees(np.arctan2(-forward[0], forward[2])))
    for name, down in VIEWS.items():
        view = _view(yaw, down)
        seen = rays @ view[2, :3] > 0  # from the side that the viewer sees too
        # The figure itself looks down by 25 degrees.
        tilted = _view(yaw, down - 25.0)
        path = folder / f"points-{len(drawn) + 1}.png"
        figures.point_clouds(path, found[seen], true[seen], colours[seen], tilted)
        drawn.append((path, name))
    return drawn


def _view(yaw: float, down: float) -> np.ndarray:
    """World-to-camera [4, 4] of a viewer who looks down by an angle; both in degrees, the world is y down."""
    a, b = np.radians([yaw, down])
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    tilt = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    view = np.eye(4)
    view[:3, :3] = tilt @ turn
    return view


def _room_numbers(room: Frames, result: Reconstruction, depth: np.ndarray) -> tuple[Table, str]:
    """The numbers of this room as a table, and what they say of the path in a sentence."""
    extrinsics = room.extrinsics.astype(np.float64)
    still = np.tile(np.eye(4), (len(extrinsics), 1, 1))
    radius = rms_radius(camera_centres(extrinsics))
    identity = relative_pose_errors(still, extrinsics)[0].mean()
    try:
        ate: float | None = trajectory_errors(invert(result.extrinsics), invert(extrinsics))["ate"]
    except NotMeasurable:
        ate = None
    header = ["", "Abs Rel", "δ<1.25", "rotation / identity", "RRA@5", "RTA@30", "AUC@30", "ATE (m)", "ATE / radius"]
    rows = [
        ["LoG-VGGT", *_depth_cells(depth, room), *_pose_cells(result.extrinsics, extrinsics, identity)],
        ["constant depth, camera that stands still", *_depth_cells(np.ones_like(room.depth), room)],
    ]
    rows[0] += ["-", "-"] if ate is None else [f"{ate:.3f}", f"{ate / radius:.3f}"]
    rows[1] += [*_pose_cells(still, extrinsics, identity), f"{radius:.3f}", "1.000"]
    note = (
        "Abs Rel: mean relative error of depth; rotation / identity: 0 is right, 1 is no better than no rotation; "
        "RRA@5, RTA@30: fraction of pairs of frames whose rotation is right to 5 degrees, whose direction of travel to "
        "30; ATE: distance of the cameras from the truth after the best similarity (root mean square)."
    )
    words = "could not be laid over the truth" if ate is None else f"is {100 * ate:.0f} cm from the truth"
    sentence = f"The path {words}; a camera that stood still would be {100 * radius:.0f} cm off."
    return Table(f"This room, {len(extrinsics)} frames", header, rows, (note,)), sentence


def _depth_cells(depth: np.ndarray, room: Frames) -> list[str]:
    errors = depth_metrics(depth, room.depth, alignment="median")
    return [f"{errors['abs_rel']:.3f}", f"{errors['delta_1.25']:.3f}"]


def _pose_cells(predicted: np.ndarray, true: np.ndarray, identity: float) -> list[str]:
    rotation, direction = relative_pose_errors(predicted, true)
    at_30 = pose_accuracy(rotation, direction)
    values = (rotation.mean() / identity, pose_accuracy(rotation, direction, 5)["rra"], at_30["rta"], at_30["auc"])
    return [f"{value:.3f}" for value in values]


def _evaluation(folder: Path) -> list[str]:
    with disk_errors(folder / "results.json"):
        results = json.loads((folder / "results.json").read_text())
    return [
        page.heading("Rooms that training never saw, against answers that need no learning"),
        page.paragraph(
            "The best value of a column is bold. The untrained network is the same one with random numbers, VGGT the "
            "same weights without windows and refinement. A camera that stands still cannot be laid over the truth: "
            f"its ATE, marked {MARK}, is the size of the path. What every column means is in evaluation/report.html."
        ),
        *(table_part(table) for table in benchmark_tables(results)),
    ]


def _training(folder: Path, figures_folder: Path) -> list[str]:
    """What training from nothing learned within the demo's time."""
    with disk_errors(folder / FILE_NAME):
        entries = read_metrics(folder / FILE_NAME)
    training = [(entry["step"], entry["train/abs_rel"]) for entry in entries if "train/abs_rel" in entry]
    if not training:
        raise MissingInput(f"{folder / FILE_NAME}: no step; the training ended before the first one")
    held_out = [entry for entry in entries if "validation/abs_rel" in entry]
    curves = {"tiny model, as it trains": training}
    (first, before), (final, after) = training[0], training[-1]
    sentence = f"Abs Rel of its depth went from {before:.3f} at step {first} to {after:.3f} at step {final}"
    if held_out:  # a slow machine compiles for most of the time
        curves["tiny model, on other rooms"] = [(entry["step"], entry["validation/abs_rel"]) for entry in held_out]
        curves["constant depth, there"] = [(entry["step"], entry["validation/constant_abs_rel"]) for entry in held_out]
        last = held_out[-1]
        sentence += (
            f"; on rooms that are not trained on to {last['validation/abs_rel']:.3f}, where a constant depth has "
            f"{last['validation/constant_abs_rel']:.3f}"
        )
    path = figures_folder / "training.png"
    figures.curves_plot(path, curves, "Error of depth", x_label="steps", y_label="Abs Rel")
    return [
        page.heading("Training from nothing"),
        page.figure(
            path,
            "How the error of depth falls while a tiny model, another one than above, learns from random numbers on.",
        ),
        page.paragraph(f"{sentence}. Camera poses take hours: the model above had them."),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Parses and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the demo's folder")
    try:
        path = write_page(parser.parse_args(arguments).folder)
    except InputError as error:
        sys.exit(f"demo_page.py: {one_line(error)}")
    print(f"open {printable(str(path))} in a browser: pictures, numbers, and the command that opens the viewer")


if __name__ == "__main__":
    main()
