"""The health report of a result, as files: numbers as JSON, and one page with plots and words."""

from __future__ import annotations

import dataclasses
import json
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax import page
from logvggt_jax.errors import InputError, one_line, printable
from logvggt_jax.files import read_json, write_text
from logvggt_jax.reconstruction.health.measures import NAMES, TITLES, Measures
from logvggt_jax.reconstruction.health.plot import svg_plot
from logvggt_jax.reconstruction.health.rules import CAUSES, SIGNS, Stretch, doubtful, stretches
from logvggt_jax.reconstruction.health.words import in_short, paragraph, reasons

HEALTH_FILE, HEALTH_PAGE = "health.json", "health.html"
_FORMAT = "logvggt-health-1"
# Measures that the first reports of this format do not have.
_LATER = ("detail", "likeness", "shared_picture", "elsewhere")


@dataclasses.dataclass(frozen=True, eq=False)
class Health:
    """Which frames of a result are doubtful, and why.

    Attributes:
      measures: of the N frames.
      stretches: of doubtful frames, with what most likely caused them.
      text: the same as a paragraph.
    """

    measures: Measures
    stretches: tuple[Stretch, ...]
    text: str

    @property
    def doubtful(self) -> np.ndarray:
        """Which frames are doubtful; bool [N]."""
        return doubtful(self.stretches, self.measures.num_frames)

    @property
    def in_short(self) -> str:
        """The stretches in one line."""
        return in_short(self.stretches, self.measures.num_frames)


def examine(measures: Measures, names: Sequence[str]) -> Health:
    """The health of frames of these names."""
    found = stretches(measures)
    return Health(measures, found, paragraph(found, measures, names))


def write_health(folder: Path, health: Health, names: Sequence[str]) -> None:
    """Writes `health.json` and `health.html` into a result folder; the first only where the second is written."""
    document = {
        "format": _FORMAT,
        "text": health.text,
        "stretches": [stretch._asdict() for stretch in health.stretches],
        "names": list(names),
        "measures": {
            name: [value if np.isfinite(value) else None for value in array.tolist()]
            for name, array in health.measures.arrays().items()
        },
    }
    write_text(folder / HEALTH_PAGE, _page(health, names))
    write_text(folder / HEALTH_FILE, json.dumps(document) + "\n")


def read_health(folder: Path) -> Health | None:
    """Inverse of `write_health`; None where a result has no report, as those of earlier versions.

    Raises:
      InputError: the file is damaged.
    """
    file = folder / HEALTH_FILE
    if not file.exists():
        return None
    try:
        return _parsed(read_json(file, "so it is not a health report of this program, or damaged"))
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise InputError(f"{file} is not a health report of this program, or damaged: {one_line(error)}") from None


@contextmanager
def without_harm() -> Iterator[None]:
    """Turns any failure of the report into a warning: a result is worth more than what is said of it."""
    try:
        yield
    except Exception as error:
        warnings.warn(
            f"no health report: {type(error).__name__} ({one_line(error)}); the result itself is not touched by it",
            stacklevel=3,
        )


def _parsed(document: dict[str, Any]) -> Health:
    if document["format"] != _FORMAT:
        raise ValueError(f"format {document['format']!r:.40}, expected {_FORMAT!r}")
    stored, count = document["measures"], len(document["names"])
    stored |= {name: [None] * count for name in _LATER if name not in stored}
    arrays = {name: np.array(stored[name], np.float64) for name in NAMES}
    if any(array.shape != (count,) for array in arrays.values()):
        raise ValueError(f"measures must have one number for each of the {count} frames")
    found = tuple(
        Stretch(each["cause"], each["first"], each["last"], tuple(each["signs"])) for each in document["stretches"]
    )
    for cause, first, last, signs in found:
        known = cause in (None, *CAUSES) and all(name in SIGNS for name in signs)
        if not (known and type(first) is int and type(last) is int and 0 <= first <= last < count):
            raise ValueError("a stretch names no cause of this program, or no frames of this result")
    if not isinstance(document["text"], str):
        raise ValueError("the text is none")
    return Health(Measures(**arrays), found, document["text"])


def _page(health: Health, names: Sequence[str]) -> str:
    measures, found = health.measures, health.stretches
    shaded = [(stretch.first, stretch.last) for stretch in found]
    parts = [page.paragraph(printable(health.text))]
    if found:
        parts.append(page.heading("Doubtful frames"))
        parts += [
            page.paragraph(
                printable(f"{each.first} to {each.last} ({names[each.first]} to {names[each.last]}): {reasons(each)}.")
            )
            for each in found
        ]
    parts += [page.heading("Measures"), page.paragraph("Over the frames; doubtful ones are tinted.")]
    plots = [
        page.drawing(svg_plot(values, shaded, label=TITLES[name][0]), "{} ({})".format(*TITLES[name]))
        for name, values in measures.arrays().items()
        if np.isfinite(values).any()
    ]
    parts.append(page.side_by_side(plots))
    return page.document("Health of a reconstruction", parts)
