"""What a network sees of a benchmark's pictures: the three rules of published evaluations, and `Fit`.

Each rule takes frames as their data set hands them out. Sizes are given for a longer edge of 518 pixels, the
VGGT family's; other lengths (a small model's) scale them. Sources: the evaluation code of the VGGT family (3D
reconstruction: crop about the principal point; video depth: whole picture; poses: VGGT's own loader).
"""

import dataclasses
from typing import ClassVar, Protocol

import cv2
import numpy as np
from PIL import Image

from logvggt_jax.config import PATCH
from logvggt_jax.data.feeding.transforms import fit
from logvggt_jax.errors import InputError
from logvggt_jax.types import Frames

_REFERENCE_EDGE = 518


class ImageRule(Protocol):
    """Frames of a data set to frames with images for the network.

    Depth and intrinsics follow the images where `keeps_grid`; otherwise they stay those of the data set, and
    predicted depth has to be resized to them.
    """

    @property
    def keeps_grid(self) -> bool: ...

    def __call__(self, frames: Frames) -> Frames: ...

    def size(self, source: tuple[int, ...]) -> tuple[int, int]:
        """(H, W) of the images of pictures of `source` (H, W)."""
        ...

    def describe(self) -> str:
        """For the report."""
        ...


@dataclasses.dataclass(frozen=True)
class Fit:
    """Cropped and resized to (H, W) with the principal point in the middle, as in training; see `transforms.fit`."""

    image_size: tuple[int, int]
    keeps_grid: ClassVar[bool] = True

    def __call__(self, frames: Frames) -> Frames:
        return fit(frames, self.image_size)

    def size(self, source: tuple[int, ...]) -> tuple[int, int]:
        """(H, W), whatever the pictures have."""
        del source
        return self.image_size

    def describe(self) -> str:
        height, width = self.image_size
        return f"{width} x {height} pixels, cropped and resized about the principal point"


@dataclasses.dataclass(frozen=True)
class PrincipalPointCrop:
    """Largest crop with the principal point in the middle, resized to cover 518 x 392, its middle cut out.

    Images by Lanczos when shrinking, bicubic when enlarging; depth nearest. Portrait pictures get 392 x 518.
    """

    longer_edge: int = _REFERENCE_EDGE
    keeps_grid: ClassVar[bool] = True

    def __call__(self, frames: Frames) -> Frames:
        parts = [
            crop_about_principal_point(*frame, self.size(frames.images.shape[1:3]))
            for frame in zip(frames.images, frames.depth, frames.intrinsics.astype(np.float64), strict=True)
        ]
        images, depth, intrinsics = (np.stack(column) for column in zip(*parts, strict=True))
        return frames._replace(images=images, depth=depth, intrinsics=intrinsics.astype(np.float32))

    def size(self, source: tuple[int, ...]) -> tuple[int, int]:
        """(H, W) for pictures of `source` (H, W)."""
        shorter = max(PATCH, round(self.longer_edge * 392 / _REFERENCE_EDGE / PATCH) * PATCH)
        return (shorter, self.longer_edge) if source[1] >= source[0] else (self.longer_edge, shorter)

    def describe(self) -> str:
        height, width = self.size((3, 4))
        return f"{width} x {height} pixels, cropped about the principal point"


@dataclasses.dataclass(frozen=True)
class WholePicture:
    """Longer edge 518, the other rounded and then cut to a multiple of 14; nothing is cropped."""

    longer_edge: int = _REFERENCE_EDGE
    keeps_grid: ClassVar[bool] = False

    def __call__(self, frames: Frames) -> Frames:
        size = self.size(frames.images.shape[1:3])
        return frames._replace(images=np.stack([resize_image(image, size) for image in frames.images]))

    def size(self, source: tuple[int, ...]) -> tuple[int, int]:
        """(H, W) for pictures of `source` (H, W)."""
        edges = [round(edge * self.longer_edge / max(source)) for edge in source]
        return max(PATCH, edges[0] // PATCH * PATCH), max(PATCH, edges[1] // PATCH * PATCH)

    def describe(self) -> str:
        return f"whole pictures, longer edge {self.longer_edge} pixels, the other cut to a multiple of {PATCH}"


@dataclasses.dataclass(frozen=True)
class WidthResize:
    """Width 518, height the nearest multiple of 14; of taller pictures the middle 518 rows. VGGT's loader."""

    width: int = _REFERENCE_EDGE
    keeps_grid: ClassVar[bool] = False

    def __call__(self, frames: Frames) -> Frames:
        height = self._height(frames.images.shape[1:3])
        kept = min(height, self.width)
        top = (height - kept) // 2
        images = [resize_image(image, (height, self.width), lanczos=False)[top : top + kept] for image in frames.images]
        return frames._replace(images=np.stack(images))

    def size(self, source: tuple[int, ...]) -> tuple[int, int]:
        """(H, W) for pictures of `source` (H, W)."""
        return min(self._height(source), self.width), self.width

    def describe(self) -> str:
        return f"width {self.width} pixels, height the nearest multiple of {PATCH}"

    def _height(self, source: tuple[int, ...]) -> int:
        return max(PATCH, round(source[0] * self.width / source[1] / PATCH) * PATCH)


def crop_about_principal_point(
    image: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One frame as `PrincipalPointCrop` hands it out: image [h, w, 3], depth [h, w] and intrinsics [3, 3], `size` (h,
    w).

    The frame is an image [H, W, 3] uint8 with depth [H, W] and intrinsics [3, 3] float64. The intrinsics handed out are
    the reference's: the crop of the resized picture falls on whole pixels, its principal point on the exact half
    margin, so that they may differ by half a pixel. Raises InputError where the principal point lies outside the
    picture.
    """
    source_height, source_width = image.shape[:2]
    centre_u, centre_v = (round(float(c)) for c in intrinsics[:2, 2])
    half_width = min(centre_u, source_width - centre_u)
    half_height = min(centre_v, source_height - centre_v)
    if half_width < 1 or half_height < 1:
        raise InputError(
            f"the principal point ({centre_u}, {centre_v}) lies outside the image of size "
            f"{(source_height, source_width)}: correct the intrinsics"
        )
    left, top = centre_u - half_width, centre_v - half_height
    image = image[top : top + 2 * half_height, left : left + 2 * half_width]
    depth = depth[top : top + 2 * half_height, left : left + 2 * half_width]
    cropped = np.array(image.shape[1::-1], np.float64)
    target = np.array(size[::-1])
    scale = float(np.max(target / cropped)) + 1e-8
    covering = np.floor(cropped * scale).astype(int)
    image = resize_image(image, (int(covering[1]), int(covering[0])))
    depth = cv2.resize(depth, (int(covering[0]), int(covering[1])), interpolation=cv2.INTER_NEAREST)
    margin = (cropped * scale - target) / 2
    x, y = (int(m) for m in np.rint(margin).astype(int).clip(0, covering - target))
    result = intrinsics.copy()
    result[:2] *= scale
    result[:2, 2] = (intrinsics[:2, 2] - [left, top] + 0.5) * scale - margin - 0.5
    return image[y : y + size[0], x : x + size[1]], depth[y : y + size[0], x : x + size[1]], result


def resize_image(image: np.ndarray, size: tuple[int, int], *, lanczos: bool = True) -> np.ndarray:
    """Image [H, W, 3] uint8 at `size` (h, w) by Pillow's antialiased Lanczos filter where it shrinks, else bicubic."""
    if image.shape[:2] == size:
        return image
    shrinks = size[0] * size[1] < image.shape[0] * image.shape[1]
    resampling = Image.Resampling.LANCZOS if lanczos and shrinks else Image.Resampling.BICUBIC
    return np.asarray(Image.fromarray(image).resize((size[1], size[0]), resampling))
