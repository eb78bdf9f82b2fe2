"""A health report in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from logvggt_jax.reconstruction.health.measures import Measures
from logvggt_jax.reconstruction.health.rules import CAUSES, FEWEST, SIGNS, Stretch, doubtful

# Stretches that are told of those with a cause, and of those without.
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
        few = f" Most rules need {FEWEST} frames or more, and say nothing here." if count < FEWEST else ""
        return (
            f"None of the {count} frames is doubtful: no sign of trouble, and nothing wrong seen in the footage.{few}"
        )
    parts = [f"{frames} of {count} frames {'is' if frames == 1 else 'are'} doubtful."]
    explained = [stretch for stretch in found if stretch.cause is not None]
    others = [stretch for stretch in found if stretch.cause is None]
    parts += [_sentence(stretch, measures, names) for stretch in _longest(explained)]
    if others:
        parts.append(_unexplained(_longest(others), names))
    if left := max(0, len(explained) - _MOST) + max(0, len(others) - _MOST):
        parts.append(f"{left} shorter {'stretch is' if left == 1 else 'stretches are'} in its list.")
    return " ".join(parts)


def _longest(found: Sequence[Stretch]) -> list[Stretch]:
    """Those that are told, in their order."""
    longest = sorted(found, key=lambda stretch: stretch.first - stretch.last)[:_MOST]
    return sorted(longest, key=lambda stretch: stretch.first)


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
    evidence = _evidence(stretch, measures)
    return f"{_where([stretch], names)}: most likely {reasons(stretch)}{f' ({evidence})' if evidence else ''}."


def _unexplained(found: Sequence[Stretch], names: Sequence[str]) -> str:
    signs = tuple(name for name in SIGNS if any(name in stretch.signs for stretch in found))
    return f"{_where(found, names)}: {reasons(found[0]._replace(signs=signs))}."


def _where(found: Sequence[Stretch], names: Sequence[str]) -> str:
    told = [
        f"{_numbers(each)} ({names[each.first]}{'' if each.first == each.last else f' to {names[each.last]}'})"
        for each in found
    ]
    several = len(found) > 1 or found[0].first != found[0].last
    return f"Frame{'s' if several else ''} {', '.join(told)}"


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
