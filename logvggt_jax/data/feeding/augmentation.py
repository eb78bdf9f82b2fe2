"""Random changes of colour and sharpness, of whole clips or frame by frame; cameras and depth do not change."""

from dataclasses import dataclass, fields

import cv2
import numpy as np

from logvggt_jax.errors import InputError

_LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601
_GREY_AXIS = np.array([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]]) / np.sqrt(3.0)


@dataclass(frozen=True)
class ColourAugmentation:
    """Colour jitter, grey pictures and blur, each drawn on its own."""

    shared: float  # probability that one draw serves the whole clip; else every frame has its own
    jitter: float  # probability of changed colours
    brightness: float  # colours are multiplied by a factor from [1 - brightness, 1 + brightness]
    contrast: float  # so are their distances from the mean luma
    saturation: float  # and their distances from grey
    hue: float  # colours are turned about the grey axis by up to this part of a full turn, at most 0.5
    grey: float  # probability of pictures without colour
    blur: float  # probability of a Gaussian blur
    blur_sigma: tuple[float, float]  # its smallest and largest standard deviation in pixels

    def __post_init__(self) -> None:
        object.__setattr__(self, "blur_sigma", tuple(self.blur_sigma))
        limits = {"hue": 0.5}
        for name in (field.name for field in fields(self) if field.name != "blur_sigma"):
            value, limit = getattr(self, name), limits.get(name, 1.0)
            if not 0 <= value <= limit:
                raise InputError(f"augmentation.{name} must lie in [0, {limit:g}], got {value}")
        if len(self.blur_sigma) != 2 or not 0 < self.blur_sigma[0] <= self.blur_sigma[1]:
            raise InputError(f"augmentation.blur_sigma must be a pair 0 < low <= high, got {self.blur_sigma}")

    def __call__(self, images: np.ndarray, rng: np.random.Generator) -> None:
        """Changes `images`, uint8 RGB [T, H, W, 3] in C order, in place."""
        groups = [slice(None)] if rng.random() < self.shared else [slice(i, i + 1) for i in range(len(images))]
        for group in groups:
            self._change(images[group], rng)

    def _change(self, images: np.ndarray, rng: np.random.Generator) -> None:
        """One draw for all `images`."""
        colours, offset = np.eye(3), 0.0
        if rng.random() < self.jitter:
            brightness, contrast, saturation = (
                1.0 + strength * rng.uniform(-1.0, 1.0)
                for strength in (self.brightness, self.contrast, self.saturation)
            )
            mean_luma = float(np.mean([_LUMA @ cv2.mean(image)[:3] for image in images]))
            colours = contrast * brightness * _hue_turn(self.hue * rng.uniform(-1.0, 1.0)) @ _saturation(saturation)
            # The other steps keep grey as it is, so that this is the whole constant part.
            offset = (1.0 - contrast) * brightness * mean_luma
        if rng.random() < self.grey:
            colours = _saturation(0.0) @ colours
        sigma = float(rng.uniform(*self.blur_sigma)) if rng.random() < self.blur else None
        # All steps are one affine map of the colours: clipped once, and rounded once to 0.6 of a level.
        affine = np.column_stack([colours, np.full(3, offset)])
        for image in images:
            cv2.transform(image, affine, dst=image)
            if sigma is not None:
                cv2.GaussianBlur(image, (0, 0), sigma, dst=image)


def _saturation(factor: float) -> np.ndarray:
    """Matrix [3, 3] that scales a colour's distance from the grey of its luma."""
    return factor * np.eye(3) + (1.0 - factor) * np.ones((3, 1)) * _LUMA


def _hue_turn(turns: float) -> np.ndarray:
    """Rotation [3, 3] of RGB about the grey axis (Rodrigues); a third of a turn makes red green."""
    angle = 2.0 * np.pi * turns
    return np.cos(angle) * np.eye(3) + (1.0 - np.cos(angle)) / 3.0 * np.ones((3, 3)) + np.sin(angle) * _GREY_AXIS
