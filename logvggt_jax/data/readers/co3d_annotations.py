"""Annotations of Co3Dv2: gzip JSON of hundreds of megabytes a category, kept in compact form."""

import gzip
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.data.formats.calibration import pinhole, world_to_camera
from logvggt_jax.data.formats.json_values import expecting, read_json, text_of
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.errors import InputError

# x left, y up to x right, y down.
_PYTORCH3D_AXES = np.diag([-1.0, -1.0, 1.0])
# Units of a scene are about the object's size; reconstructions that failed put cameras beyond this.
_MAX_DISTANCE = 1e5
_MAX_DEPTH_SCALE = 1e6
_FORMATS = ("ndc_isotropic", "ndc_norm_image_bounds")


@dataclass(frozen=True, slots=True)
class FrameAnnotation:
    """What a frame's record needs of its annotation.

    Attributes:
      sequence, number: what set lists call the frame; numbers give the order in time.
      image, depth, depth_mask: files relative to the root; None where there is none.
      size: the picture's (H, W).
      depth_scale: factor on the stored depth.
      camera: float64 [16]: R row by row, T, focal lengths, principal point, as stored; None where there is none.
      format: of the last four, one of `ndc_isotropic` and `ndc_norm_image_bounds`.
    """

    sequence: str
    number: int
    image: str
    depth: str | None
    depth_mask: str | None
    size: tuple[int, int]
    depth_scale: float
    camera: np.ndarray | None
    format: str

    def extrinsics(self, where: str) -> np.ndarray | None:
        """World-to-camera [4, 4] float64, OpenCV axes; None without a camera or with one that is lost.

        PyTorch3D transforms row vectors, `X_camera = X_world R + T`, and its axes point left, up and forward.

        Raises InputError naming `where` for a matrix that is no rotation.
        """
        if self.camera is None:
            return None
        rotation, translation = self.camera[:9].reshape(3, 3), self.camera[9:12]
        if not np.abs(translation).max() <= _MAX_DISTANCE or not np.isfinite(rotation).all():
            return None
        pose = np.column_stack([_PYTORCH3D_AXES @ rotation.T, _PYTORCH3D_AXES @ translation])
        return world_to_camera(pose, where, stored="world_to_camera")

    def intrinsics(self) -> np.ndarray:
        """Intrinsics [3, 3] float64 in pixels of `size`, centres at integers; only of frames with a camera.

        In normalised coordinates the picture's centre is 0 and x and y grow to the left and up. `ndc_isotropic`: half
        the shorter edge is 1; `ndc_norm_image_bounds`: half of each edge is 1.
        """
        assert self.camera is not None
        height, width = self.size
        half = (width / 2, height / 2)
        unit = (min(half), min(half)) if self.format == "ndc_isotropic" else half
        focal, point = self.camera[12:14], self.camera[14:16]
        # Pixels are bounded, not centred, by integers there.
        return pinhole(
            focal[0] * unit[0],
            focal[1] * unit[1],
            half[0] - point[0] * unit[0] - 0.5,
            half[1] - point[1] * unit[1] - 0.5,
        )


def frame_annotations(
    files: SourceFiles, path: Path, chosen: set[tuple[str, int]] | None
) -> dict[str, list[FrameAnnotation]]:
    """A category's frames by sequence, in time order; only the `chosen` (sequence, number) unless that is None.

    Raises MissingFiles or InputError naming `path`.
    """
    annotations: dict[str, list[FrameAnnotation]] = {}
    # Made compact while parsed: all of a category's dictionaries would take gigabytes.
    for annotation in _content(files, path, _compact):
        if not isinstance(annotation, FrameAnnotation):
            raise InputError(f"{path}: expected a list of frames with sequence_name and frame_number: fetch it again")
        if chosen is None or (annotation.sequence, annotation.number) in chosen:
            annotations.setdefault(annotation.sequence, []).append(annotation)
    for frames in annotations.values():
        frames.sort(key=lambda frame: frame.number)
    return annotations


def quality_scores(files: SourceFiles, path: Path) -> dict[str, float]:
    """How good each sequence's cameras are (`viewpoint_quality_score`), -inf where that is unknown.

    Raises MissingFiles or InputError naming `path`.
    """
    scores = {}
    for sequence in _content(files, path, None):
        with expecting(path, "sequences with sequence_name and viewpoint_quality_score"):
            score = sequence["viewpoint_quality_score"]
            scores[text_of(sequence["sequence_name"])] = -np.inf if score is None else float(score)
    return scores


def _content(files: SourceFiles, path: Path, hook: Callable[[dict], Any] | None) -> list:
    data = files.content(path, "the category's annotations; unpack its first zip file again")
    try:
        text = gzip.decompress(data)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path}: truncated or damaged gzip file ({error}): fetch it again") from error
    content = read_json(text, path, hook)
    if not isinstance(content, list):
        raise InputError(f"{path}: expected a JSON list, got {type(content).__name__}: fetch it again")
    return content


def _compact(value: dict) -> dict | FrameAnnotation:
    """A frame's dictionary as `FrameAnnotation`, others as they are."""
    if "frame_number" not in value or "sequence_name" not in value:
        return value
    depth, viewpoint = value.get("depth") or {}, value.get("viewpoint")
    kind = (viewpoint or {}).get("intrinsics_format", "ndc_norm_image_bounds")
    if kind not in _FORMATS:
        raise ValueError(f"intrinsics_format {kind!r:.40} is none of {', '.join(_FORMATS)}")
    height, width = (int(length) for length in value["image"]["size"])
    depth_scale = float(depth.get("scale_adjustment", 1.0))
    if min(height, width) < 1 or not 0 < depth_scale <= _MAX_DEPTH_SCALE:
        raise ValueError(f"an image of {width} x {height} and scale_adjustment {depth_scale:g}")
    return FrameAnnotation(
        sequence=sys.intern(text_of(value["sequence_name"])),
        number=int(value["frame_number"]),
        image=text_of(value["image"]["path"]),
        depth=_optional_text(depth.get("path")),
        depth_mask=_optional_text(depth.get("mask_path")),
        size=(height, width),
        depth_scale=depth_scale,
        camera=None if viewpoint is None else _camera(viewpoint),
        format=kind,
    )


def _optional_text(value: Any) -> str | None:
    return None if value is None else text_of(value)


def _camera(viewpoint: dict) -> np.ndarray:
    parts = (("R", 9), ("T", 3), ("focal_length", 2), ("principal_point", 2))
    return np.concatenate([np.array(viewpoint[name], np.float64).reshape(count) for name, count in parts])
