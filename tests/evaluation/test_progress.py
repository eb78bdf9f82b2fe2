"""Progress shows names as they are, whatever they hold."""

import io

from rich.console import Console

from logvggt_jax.evaluation.progress import progress_display, track


def test_names_are_no_markup() -> None:
    console = Console(file=(shown := io.StringIO()), force_terminal=True, width=200)
    with progress_display(console) as display:
        display.add_task("rooms: [/x][red]a", total=1)
        assert list(track(range(100), 100, "[/y]")) == list(range(100))
    assert "rooms: [/x][red]a" in shown.getvalue()
