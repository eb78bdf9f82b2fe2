"""Which frames are doubtful, and what of the footage most likely made them so.

Every threshold of the report is here; docs/health.md says the same in words. Most are relative to the sequence's own
medians, since no number of a picture means the same in a cellar and on a meadow; those that compare with a small median
have an absolute bound beside it, so that a sequence without fault has no doubtful frame.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np

from logvggt_jax.reconstruction.health.measures import CONFLICTS_APART, Measures

# Medians of fewer frames say nothing: rules that need them are then left out.
FEWEST = 8

# Light. A frame is dark if so many of its pixels are nearly black, or its brightness is so small a share of the median.
DARK_PIXELS, DARK_SHARE = 0.6, 0.25
# Bright if so many pixels are nearly white, and so many times as many as in the median frame.
BRIGHT_PIXELS, BRIGHT_TIMES = 0.3, 2.0
# A jump of the exposure from one frame to the next, in stops (powers of two). Where the picture changes by less than
# this beside its light, the camera has not moved, whatever depth and cameras that suffer from the jump say.
EXPOSURE_STOPS, SAME_PICTURE = 0.7, 0.1

# Detail. No texture: gradient energy below this share of the median, or below this number.
TEXTURE_SHARE, LEAST_TEXTURE = 0.1, 2e-4
# Blur: fine detail is below this share of the median, and so is fine detail for the coarse detail that there is.
BLUR_SHARPNESS, BLUR_RATIO = 0.5, 0.35
# Of frames with less coarse detail than this share of the median nobody can say whether they are blurred.
BLUR_TEXTURE = 0.15
# A picture is blurred from one frame to the next, and everywhere, by such a factor; what comes little by little, or as
# an edge leaves the view, may as well be a smooth surface.
BLUR_STEP = 2.0

# Movement. Too fast: this much of the view is new in every frame, and so many times as much as in the median frame; or
# most of it, whatever is usual in this sequence.
NEW_VIEW, NEW_VIEW_TIMES, MOST_NEW = 0.3, 2.5, 0.5
# That is believed unless the pictures share this much at some shift: then the cameras are wrong.
SAME_VIEW = 0.9
# No overlap: nearly all of the view is new; or the picture changes as much and so many times as much as usual, while
# the method's own signals rise.
ALL_NEW, PICTURE_CHANGE, PICTURE_TIMES = 0.8, 0.6, 4.0
# What looks fast may be a cut, which predicted cameras do not tell: the picture changes so much this once, and what
# both frames would see by depth and cameras is less alike in their pictures than this.
OTHER_PICTURE, ALIKE = 0.4, 0.75
# Zoom: the focal length changes by this much over so many frames, and so many times as much as usual.
ZOOM, ZOOM_FRAMES, ZOOM_TIMES = 0.1, 8, 6.0
# Something moves: this share of the points that should be seen from four frames away is not, and so many times as many;
# and in one of the frames so much of the picture was not near its place either: depth that is wrong changes no picture.
CONFLICTS, CONFLICT_TIMES = 0.04, 4.0
# Pictures whose fine detail differs by such a factor cannot be compared for that.
ELSEWHERE, AS_SHARP = 0.06, 3.0
# Nothing that moves hides so much of the view, in any frame of a stretch.
MOST_CONFLICTS = 0.6

# Signs that the result suffers: above this number and so many times the median.
SIGNALS, SIGNAL_TIMES = 0.1, 4.0
DISAGREEMENT, DISAGREEMENT_TIMES = 0.05, 4.0
# Confidence is 1 + something: that something below this share of the median's.
CONFIDENCE_SHARE = 0.2
# Chunks: the scale changes by more than this factor from one to the next; they are this far apart where they overlap.
CHUNK_SCALE, CHUNK_RESIDUAL = 1.5, 0.1

# A stretch goes on over so many frames without the fault; a sign so near to a cause counts as its effect.
_GAP, _NEAR = 2, 4

CAUSES = {
    "no overlap": "the view jumps, so that neighbouring frames share little or nothing",
    "fast": "the camera moves too fast for the rate of frames",
    "fast or cut": "the camera moves too fast for the rate of frames, or the footage is cut",
    "dark": "it is too dark",
    "bright": "it is overexposed",
    "exposure": "the exposure jumps",
    "texture": "there is hardly any texture, as of a plain wall or the sky",
    "blur": "the picture is blurred",
    "soft": "the picture is blurred, or shows smooth surfaces",
    "zoom": "the lens zooms",
    "moving": "something moves in front of the camera",
}
SIGNS = {
    "overlap_change": "windows disagree about the same frame",
    "correction": "the global refinement moved the camera far",
    "confidence": "the model is unsure of its depth",
    "disagreement": "depth does not fit that of the frame before",
    "conflicts": "points that should be seen from four frames away are not",
    "cameras": "cameras turn away from what the pictures still show",
    "chunks": "chunks do not fit one another",
}


class Stretch(NamedTuple):
    """Neighbouring doubtful frames.

    Attributes:
      cause: a name of `CAUSES`; None where the result shows signs of trouble and the footage does not say why.
      first: the first frame.
      last: the last frame.
      signs: names of `SIGNS` that show in or near these frames.
    """

    cause: str | None
    first: int
    last: int
    signs: tuple[str, ...]


def stretches(measures: Measures) -> tuple[Stretch, ...]:
    """All stretches of doubtful frames, by their first frame."""
    with warnings.catch_warnings(), np.errstate(divide="ignore", invalid="ignore"):
        warnings.filterwarnings("ignore", "All-NaN|Mean of empty", RuntimeWarning)
        pictures = _pictures(measures)
        signs = _signs(measures, pictures)
        causes = _causes(measures, pictures, signs)
    found = [
        Stretch(cause, first, last, tuple(name for name, frames in signs.items() if _around(frames, first, last).any()))
        for cause, frames in causes.items()
        for first, last in _runs(frames)
    ]
    explained = np.zeros(measures.num_frames, bool)
    for stretch in found:
        explained[max(0, stretch.first - _NEAR) : stretch.last + _NEAR + 1] = True
    rest = {name: frames & ~explained for name, frames in signs.items()}
    for first, last in _runs(np.logical_or.reduce(list(rest.values()))):
        found.append(Stretch(None, first, last, tuple(n for n, f in rest.items() if f[first : last + 1].any())))
    return tuple(sorted(found, key=lambda stretch: (stretch.first, stretch.last)))


def doubtful(found: tuple[Stretch, ...], count: int) -> np.ndarray:
    """Which of `count` frames lie in a stretch; bool [N]."""
    frames = np.zeros(count, bool)
    for stretch in found:
        frames[stretch.first : stretch.last + 1] = True
    return frames


def _pictures(m: Measures) -> dict[str, np.ndarray]:
    """What the pictures by themselves have to do with it, by cause."""
    dark = (m.dark > DARK_PIXELS) | (m.brightness < DARK_SHARE * _median(m.brightness))
    bright = (m.bright > BRIGHT_PIXELS) & ~(m.bright <= BRIGHT_TIMES * _median(m.bright))
    texture = (m.texture < LEAST_TEXTURE) | (m.texture < TEXTURE_SHARE * _median(m.texture))
    texture &= ~dark & ~bright
    poor = dark | bright | texture
    ratio = np.where(poor, np.nan, m.sharpness / m.texture)
    blur = (m.sharpness < BLUR_SHARPNESS * _median(m.sharpness)) & (ratio < BLUR_RATIO * _median(ratio)) & ~poor
    blur, soft = _sudden(blur & (m.texture > BLUR_TEXTURE * _median(m.texture)), m.detail)
    return {"dark": dark, "bright": bright, "texture": texture, "blur": blur, "soft": soft}


def _poor(pictures: dict[str, np.ndarray]) -> np.ndarray:
    """Frames that show nothing."""
    return pictures["dark"] | pictures["bright"] | pictures["texture"]


def _causes(m: Measures, pictures: dict[str, np.ndarray], signs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    poor = _poor(pictures)
    zoom = _over(_zoom(np.where(poor, np.nan, m.field_of_view)), ZOOM, ZOOM_TIMES)
    new = 1 - m.overlap
    # A picture says nothing where it, or the one before, shows nothing.
    clear = ~(poor | np.concatenate([[False], poor[:-1]]))
    unsure = signs["overlap_change"] | signs["correction"] | signs["disagreement"]
    cut = _over(m.picture_change, PICTURE_CHANGE, PICTURE_TIMES) & clear & unsure
    stops = np.abs(np.log2(m.brightness / np.concatenate([[np.nan], m.brightness[:-1]])))
    jump = (stops > EXPOSURE_STOPS) & clear
    # Nor is what a model makes of such pictures a movement.
    elsewhere = clear & ~(jump & (m.picture_change < SAME_PICTURE))
    moving = _over(m.conflicts, CONFLICTS, CONFLICT_TIMES) & ~signs["conflicts"] & elsewhere
    far = _far(m) & ~signs["cameras"] & elsewhere
    fast = far & ~(new > ALL_NEW) & ~zoom
    no_overlap = (far & (new > ALL_NEW)) | (cut & ~moving & ~fast)
    fast_or_cut = fast & (m.likeness < ALIKE) & _alone(m.picture_change > OTHER_PICTURE)
    moving &= ~_across(no_overlap | fast)
    exposure = jump & ~no_overlap & ~fast & ~moving
    found = pictures | {
        "no overlap": no_overlap,
        "fast": fast & ~fast_or_cut,
        "fast or cut": fast_or_cut,
        "exposure": exposure,
        "zoom": zoom,
        "moving": moving & ~zoom & ~no_overlap,
    }
    return {name: found[name] for name in CAUSES}


def _signs(m: Measures, pictures: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    scales = np.full(m.num_frames, np.nan)
    missing = _over(m.conflicts, CONFLICTS, CONFLICT_TIMES)
    seen_to_move = (m.elsewhere > ELSEWHERE) & _comparable(m, _poor(pictures))
    no_movement = np.zeros(m.num_frames, bool)
    for first, last in _runs(missing):  # one error makes conflicts of all sizes
        run = slice(first, last + 1)
        hidden = (m.conflicts[run] > MOST_CONFLICTS).any()
        no_movement[run] |= hidden or not _around(seen_to_move, first, last).any()
    joints = np.flatnonzero(np.isfinite(m.chunk_scale))
    scales[joints] = np.abs(np.diff(np.log(m.chunk_scale[joints]), prepend=0.0))  # the first chunk's is one
    return {
        "overlap_change": _over(m.overlap_change, SIGNALS, SIGNAL_TIMES),
        "correction": _over(m.correction, SIGNALS, SIGNAL_TIMES),
        "confidence": m.confidence - 1 < CONFIDENCE_SHARE * (_median(m.confidence) - 1),
        "disagreement": _over(m.disagreement, DISAGREEMENT, DISAGREEMENT_TIMES),
        "conflicts": missing & no_movement,
        "cameras": _far(m) & (m.shared_picture > SAME_VIEW),
        "chunks": (scales > np.log(CHUNK_SCALE)) | (m.chunk_residual > CHUNK_RESIDUAL),
    }


def _median(values: np.ndarray) -> float:
    """NaN, which nothing is above or below, where too few are known."""
    return float(np.nanmedian(values)) if np.isfinite(values).sum() >= FEWEST else np.nan


def _over(values: np.ndarray, least: float, times: float) -> np.ndarray:
    over: np.ndarray = (values > least) & (values > times * _median(values))
    return over


def _far(m: Measures) -> np.ndarray:
    """Frames of which the cameras say that much of the view is new."""
    new = 1 - m.overlap
    return _over(new, NEW_VIEW, NEW_VIEW_TIMES) | (new > MOST_NEW)


def _comparable(m: Measures, poor: np.ndarray) -> np.ndarray:
    """Frames whose picture can be compared with that of the frame four before: both show something, as sharply."""
    earlier = np.maximum(np.arange(m.num_frames) - CONFLICTS_APART, 0)
    as_sharp = np.abs(np.log(m.sharpness / m.sharpness[earlier])) < np.log(AS_SHARP)
    return as_sharp & ~poor & ~poor[earlier]


def _sudden(blur: np.ndarray, detail: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of blurred frames those whose stretch begins or ends from one frame to the next, and the others."""
    steps = np.abs(np.diff(np.log(detail), prepend=np.nan, append=np.nan))  # before each frame, and after the last
    sudden = np.zeros_like(blur)
    for first, last in _runs(blur):
        sudden[first : last + 1] = (steps[max(first - 1, 0) : last + 3] > np.log(BLUR_STEP)).any()
    return blur & sudden, blur & ~sudden


def _zoom(field_of_view: np.ndarray) -> np.ndarray:
    """The change of the focal length's logarithm over the `ZOOM_FRAMES` around each frame."""
    focal = -np.log(np.tan(np.radians(field_of_view) / 2))
    half, last = ZOOM_FRAMES // 2, len(focal) - 1
    frames = np.arange(len(focal))
    return np.abs(focal[np.minimum(frames + half, last)] - focal[np.maximum(frames - half, 0)])


def _alone(frames: np.ndarray) -> np.ndarray:
    """Those that are a run of their own."""
    alone = np.zeros(len(frames), bool)
    alone[[first for first, last in _runs(frames) if first == last]] = True
    return alone


def _across(jumps: np.ndarray) -> np.ndarray:
    """Frames whose conflicts are searched for in a frame before a jump, or a fast step: the two cannot be compared."""
    across: np.ndarray = np.convolve(jumps, np.ones(CONFLICTS_APART))[: len(jumps)] > 0
    return across


def _around(frames: np.ndarray, first: int, last: int) -> np.ndarray:
    return frames[max(0, first - _NEAR) : last + _NEAR + 1]


def _runs(frames: np.ndarray) -> list[tuple[int, int]]:
    """First and last of each run of frames that are set, over gaps of at most `_GAP`."""
    places = np.flatnonzero(frames)
    if not len(places):
        return []
    breaks = np.flatnonzero(np.diff(places) > _GAP + 1)
    return [(int(run[0]), int(run[-1])) for run in np.split(places, breaks + 1)]
