"""Order, time stamps and gaps of a sequence, as far as the names of its files tell them."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal
from itertools import pairwise
from typing import Any

_DIGITS = re.compile(r"(\d+)")
_DECIMALS = re.compile(r"(\d+(?:\.\d+)?)")
# Before a fraction, or a time of day.
_NO_COUNTER = re.compile(r"\d\.$|(?:19|20)\d\d[-_.:]?[01]\d[-_.:]?[0-3]\d\D")
_SECONDS = re.compile(r"-?\d+\.\d+|\d{10}")
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
# A date and a time of day, as cameras and recorders write it, perhaps with a fraction of the second.
_DATE = re.compile(
    r"(.*?)(?<!\d)((?:19|20)\d\d)[-_.:]?([01]\d)[-_.:]?([0-3]\d)[-_.T ]?([0-2]\d)[-_.:h]?([0-5]\d)[-_.:m]?([0-5]\d)"
    r"(?:[.,](\d{1,9})|[-_]?(\d{3}|\d{6}|\d{9}))?Z?"
)
# Whole numbers are moments if they lie between 2001 and 2100 in one of these units (per second).
_EPOCH_UNITS = (1, 10**3, 10**6, 10**9)
_EPOCH_BEGIN, _EPOCH_END = 10**9, 41 * 10**8


def natural_order(stems: Sequence[str]) -> list[int]:
    """Positions of the names in natural order: `img2` before `img10`, `0.88868` before `0.9022` before `470.0`.

    A point between digits is a decimal point, unless the digits behind it are a counter: some end with a zero that
    no number in decimals has (`1.9` before `1.10`), and their lengths differ. A dash is a minus where all names are
    numbers: `-1.5` before `-0.5` before `0.5`.
    """
    if any(stem.startswith("-") for stem in stems) and all(_NUMBER.fullmatch(stem) for stem in stems):
        return sorted(range(len(stems)), key=lambda position: (Decimal(stems[position]), stems[position], position))
    fractions = {text.partition(".")[2] for stem in stems for text in _DECIMALS.findall(stem)} - {""}
    counters = len({len(f) for f in fractions}) > 1 and any(f.endswith("0") and f != "0" for f in fractions)
    pattern = _DIGITS if counters else _DECIMALS
    return sorted(range(len(stems)), key=lambda position: (_key(stems[position], pattern), stems[position], position))


def _key(stem: str, pattern: re.Pattern[str]) -> list[tuple[Any, ...]]:
    # Split gives text and numbers in turn. Digits of a fraction are compared as text, which is exact.
    parts = enumerate(pattern.split(stem.lower()))
    return [(1, int(text.partition(".")[0]), text.partition(".")[2]) if odd % 2 else (0, text) for odd, text in parts]


def time_stamps(stems: Sequence[str]) -> list[float] | None:
    """Seconds, if all names in their order are moments that increase; None otherwise.

    Names are moments if they are decimal numbers (`1403636579.763555584`, `0.5`; among them whole seconds since
    1970), all whole numbers of seconds, milli-, micro- or nanoseconds since 1970 that lie between 2001 and 2100, or end
    with date and time of day after the same letters (`PXL_20240501_123001250`, `2024-05-01T12:30:01.25`), which are
    taken for universal time. Other whole numbers are positions.
    """
    if len(stems) < 2:
        return None
    times: list[float] | None = None
    if all(_SECONDS.fullmatch(stem) for stem in stems) and any("." in stem for stem in stems):
        times = [float(stem) for stem in stems]
    elif all(stem.isascii() and stem.isdecimal() for stem in stems):
        numbers = [int(stem) for stem in stems]
        for unit in _EPOCH_UNITS:
            if all(_EPOCH_BEGIN * unit <= number < _EPOCH_END * unit for number in numbers):
                times = [number / unit for number in numbers]
    times = times or _dates(stems)
    if times is None or any(after <= before for before, after in pairwise(times)):
        return None
    return times


def _dates(stems: Sequence[str]) -> list[float] | None:
    found = [match for stem in stems if (match := _DATE.fullmatch(stem))]
    if len(found) < len(stems) or len({match[1] for match in found}) > 1:
        return None
    try:
        moments = [datetime.strptime("".join(match.group(2, 3, 4, 5, 6, 7)), "%Y%m%d%H%M%S") for match in found]
    except ValueError:  # 31 February
        return None
    fractions = [float(f"0.{match[8] or match[9] or 0}") for match in found]
    return [moment.replace(tzinfo=UTC).timestamp() + f for moment, f in zip(moments, fractions, strict=True)]


def missing_numbers(stems: Sequence[str]) -> list[str]:
    """One line for each numbered sequence among the names that has gaps.

    Numbers may go by steps; where more are missing than there, the numbers count something else.
    """
    sequences: dict[tuple[str, str], dict[int, str]] = defaultdict(dict)
    for stem in set(stems):
        *_, last = [None, *re.finditer(r"\d+", stem)]
        if last is not None and not _NO_COUNTER.search(stem[: last.start()]) and int(last[0]) < _EPOCH_BEGIN:
            sequences[stem[: last.start()], stem[last.end() :]][int(last[0])] = stem
    lines = []
    for named in sequences.values():
        numbers = sorted(named)
        step = math.gcd(*(number - numbers[0] for number in numbers))
        if not step or (numbers[-1] - numbers[0]) // step + 1 > 2 * len(numbers):
            continue
        if missing := sorted(set(range(numbers[0], numbers[-1], step)) - named.keys()):
            some = ", ".join(map(str, missing[:10])) + (f" and {len(missing) - 10} more" if len(missing) > 10 else "")
            word, verb = ("number", "is") if len(missing) == 1 else ("numbers", "are")
            lines.append(f"{word} {some} {verb} missing between {named[numbers[0]]} and {named[numbers[-1]]}")
    return lines
