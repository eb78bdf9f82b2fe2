"""Progress of the long steps inside one clip, shown where an evaluation has opened a display."""

import contextlib
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Item = TypeVar("Item")

_DISPLAY: ContextVar[Progress | None] = ContextVar("evaluation_progress", default=None)
_SHORT = 64  # steps that are over before they could be read


@contextlib.contextmanager
def progress_display(console: Console | None) -> Iterator[Progress]:
    """A display on `console` (None: the standard one) that `track` adds its bars to while it is open."""
    # Names of sequences and methods are no markup.
    columns = (
        TextColumn("{task.description:<44}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, TimeRemainingColumn(), console=console) as display:
        token = _DISPLAY.set(display)
        try:
            yield display
        finally:
            _DISPLAY.reset(token)


def track(items: Iterable[Item], total: int, description: str) -> Iterator[Item]:
    """`items`, with a bar of `total` steps under the display's own; nothing is shown without a display."""
    display = _DISPLAY.get()
    if display is None or total < _SHORT:
        yield from items
        return
    task = display.add_task(f"  {description}", total=total)
    try:
        for item in items:
            yield item
            display.advance(task)
    finally:
        display.remove_task(task)
