"""One measure over the frames as a small SVG picture."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np

_WIDTH, _HEIGHT = 520, 120
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 8, 8, 18
# Of a longer sequence the lowest and highest of neighbouring frames are drawn.
_MOST_POINTS = 800


def svg_plot(values: np.ndarray, shaded: Sequence[tuple[int, int]], *, label: str) -> str:
    """A line over frames 0 … N - 1, dots where neighbours are unknown; the ranges `shaded` (first, last) are tinted.

    Args:
      values: [N], NaN where unknown.
      shaded: frames that are doubtful.
      label: what is drawn, for those who cannot see it.
    """
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    low = min(low, 0.0) if low < 0.5 * high else low
    if high - low < 1e-9 * max(abs(high), 1e-9):
        low, high = min(low, 0.0), max(high, 0.0) or 1.0
    last = max(len(values) - 1, 1)

    def x(frame: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * frame / last

    def y(value: float) -> float:
        return _TOP + (_HEIGHT - _TOP - _BOTTOM) * (high - value) / (high - low)

    def text(left: float, top: float, content: str, anchor: str) -> str:
        return f'<text x="{left:.1f}" y="{top:.1f}" text-anchor="{anchor}">{html.escape(content)}</text>'

    bottom = _HEIGHT - _BOTTOM
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{html.escape(label)}" font-size="11" '
        f'font-family="system-ui, sans-serif" style="max-width: {_WIDTH}px; width: 100%" '
        'xmlns="http://www.w3.org/2000/svg">',
        *(
            f'<rect x="{x(first - 0.5):.1f}" y="{_TOP}" width="{max(x(end + 0.5) - x(first - 0.5), 1):.1f}" '
            f'height="{bottom - _TOP}" fill="#f6c9b8"/>'
            for first, end in shaded
        ),
        f'<path d="M{_LEFT} {_TOP}V{bottom}H{_WIDTH - _RIGHT}" fill="none" stroke="#999"/>',
    ]
    for run in _runs(_thinned(values)):
        if len(run) == 1:
            parts.append(f'<circle cx="{x(run[0][0]):.1f}" cy="{y(run[0][1]):.1f}" r="1.5" fill="#1f5f99"/>')
        else:
            line = " ".join(f"{x(frame):.1f},{y(value):.1f}" for frame, value in run)
            parts.append(f'<polyline points="{line}" fill="none" stroke="#1f5f99"/>')
    parts += [
        text(_LEFT - 4, _TOP + 8, f"{high:.3g}", "end"),
        text(_LEFT - 4, bottom, f"{low:.3g}", "end"),
        text(_LEFT, _HEIGHT - 4, "0", "middle"),
        text(_WIDTH - _RIGHT, _HEIGHT - 4, f"frame {len(values) - 1}", "end"),
        "</svg>",
    ]
    return "".join(parts)


def _thinned(values: np.ndarray) -> list[tuple[int, float]]:
    """(frame, value), with NaN; of each of many groups of neighbours the lowest and the highest."""
    if len(values) <= _MOST_POINTS:
        return list(enumerate(values.tolist()))
    kept: set[int] = set()
    for group in np.array_split(np.arange(len(values)), _MOST_POINTS // 2):
        finite = group[np.isfinite(values[group])]
        if len(finite):
            kept |= {int(finite[values[finite].argmin()]), int(finite[values[finite].argmax()])}
        else:
            kept.add(int(group[0]))
    return [(frame, float(values[frame])) for frame in sorted(kept)]


def _runs(points: list[tuple[int, float]]) -> list[list[tuple[int, float]]]:
    """Neighbours that are known."""
    runs: list[list[tuple[int, float]]] = [[]]
    for frame, value in points:
        if np.isfinite(value):
            runs[-1].append((frame, value))
        elif runs[-1]:
            runs.append([])
    return [run for run in runs if run]
