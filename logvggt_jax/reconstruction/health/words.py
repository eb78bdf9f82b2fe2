"""A health report in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from logvggt_jax.reconstruction.health.measures import Measures
from logvggt_jax.reconstruction.health.rules import CAUSES, SIGNS, Stretch, doubtful

# Stretches that are told one by one.
_MOST = 6
# A camera whose steps are shorter, in median depths, stands still.
_STILL = 1e-3
# What is said of a cause beside its name: a measure, and how.
_EVIDENCE = {
    "no overlap": ("overlap", "the least overlap is {low:.0%} of the view, {median:.0%} in the median frame"),
    "fast": (
        "overlap",
        "neighbouring frames share as little as {low:.0%} of the view, {median:.0%} in the median frame",
    ),
    "fast or cut": (
        "likeness",
        "pictures of what both frames should show correlate by {low:.2f}, {median:.2f} in the median frame",
    ),
    "dark": ("brightness", "brightness falls to {low:.0%} of white, {median:.0%} in the median frame"),
    "bright": ("bright", "up to {high:.0%} of the pixels are white"),
    "exposure": ("brightness", "brightness jumps between {low:.0%} and {high:.0%} of white"),
    "texture": ("texture", "gradient energy falls to {of_median:.2g} times the median"),
    "blur": ("sharpness", "fine detail falls to {of_median:.2g} times the median"),
    "soft": ("sharpness", "fine detail falls to {of_median:.2g} times the median"),
    "zoom": ("field_of_view", "the field of view goes from {first:.0f} to {last:.0f} degrees"),
    "moving": ("conflicts", "up to {high:.0%} of what should be seen from four frames away is not"),
}


def paragraph(found: Sequence[Stretch], measures: Measures, names: Sequence[str]) -> str:
    """Which frames are doubtful, and what of the footage most likely caused it."""
    count = measures.num_frames
    frames = int(doubtful(tuple(found), count).sum())
    if not frames:
        return f"None of the {count} frames is doubtful: no sign of trouble, and nothing wrong with the footage."
    parts = [f"{frames} of {count} frames {'is' if frames == 1 else 'are'} doubtful."]
    # The longest are told, in their order.
    longest = sorted(found, key=lambda stretch: stretch.first - stretch.last)[:_MOST]
    parts += [_sentence(stretch, measures, names) for stretch in sorted(longest, key=lambda stretch: stretch.first)]
    if len(found) > _MOST:
        parts.append(f"{len(found) - _MOST} shorter stretches are in its list.")
    return " ".join(parts)


def in_short(found: Sequence[Stretch], count: int) -> str:
    """The same in one line."""
    frames = int(doubtful(tuple(found), count).sum())
    if not frames:
        return f"no doubtful frame among {count}"
    causes: dict[str, list[str]] = {}
    for stretch in found:
        causes.setdefault(stretch.cause or "unexplained", []).append(_numbers(stretch))
    told = "; ".join(
        f"{cause} ({', '.join(where[:3])}{' …' if len(where) > 3 else ''})" for cause, where in causes.items()
    )
    return f"{frames} of {count} frames doubtful: {told}"


def reasons(stretch: Stretch) -> str:
    """Cause and signs of a stretch, as a clause."""
    *others, last = [SIGNS[name] for name in stretch.signs] or [""]
    signs = f"{', '.join(others)} and {last}" if others else last
    if stretch.cause is None:
        return f"{signs}; nothing that is measured of the footage says why"
    return CAUSES[stretch.cause] + (f", and it shows: {signs}" if signs else ", though the result shows no sign of it")


def _sentence(stretch: Stretch, measures: Measures, names: Sequence[str]) -> str:
    where = f"Frame{'' if stretch.first == stretch.last else 's'} {_numbers(stretch)} ({names[stretch.first]}"
    where += ")" if stretch.first == stretch.last else f" to {names[stretch.last]})"
    if stretch.cause is None:
        return f"{where}: {reasons(stretch)}."
    evidence = _evidence(stretch, measures)
    return f"{where}: most likely {reasons(stretch)}{f' ({evidence})' if evidence else ''}."


def _evidence(stretch: Stretch, measures: Measures) -> str:
    measure, text = _EVIDENCE[stretch.cause or ""]
    values = getattr(measures, measure)
    first = max(stretch.first - 1, 0) if stretch.cause == "exposure" else stretch.first  # from the frame before
    there, known = values[first : stretch.last + 1], values[np.isfinite(values)]
    there = there[np.isfinite(there)]
    if not len(there):
        return ""
    median, low = float(np.median(known)), float(there.min())
    said = text.format(
        low=low, high=there.max(), median=median, of_median=low / max(median, 1e-12), first=there[0], last=there[-1]
    )
    steps = measures.step[stretch.first : stretch.last + 1]
    if stretch.cause == "moving" and np.isfinite(steps).any() and np.nanmax(steps) < _STILL:
        said += "; the camera stands still"
    return said


def _numbers(stretch: Stretch) -> str:
    return f"{stretch.first}" if stretch.first == stretch.last else f"{stretch.first} to {stretch.last}"
