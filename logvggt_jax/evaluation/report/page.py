"""A report as one HTML page: tables, notes and pictures."""

import html
import re
from collections.abc import Sequence
from pathlib import Path

from logvggt_jax.evaluation.report.tables import Table
from logvggt_jax.page import document, figure, heading


def html_page(title: str, tables: Sequence[Table], notes: Sequence[str], pictures: Sequence[Path]) -> str:
    """A report as text: tables, notes, and pictures (PNG files) under their files' names."""
    parts = [
        *(table(each) for each in tables),
        heading("Notes"),
        f"<ul>{''.join(f'<li>{html.escape(note)}</li>' for note in notes)}</ul>",
        *([heading("Figures")] if pictures else []),
        *(figure(path, path.stem) for path in pictures),
    ]
    return document(title, parts)


def table(content: Table) -> str:
    """A table under its title, its notes below."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in content.header)
    rows = "\n".join(_row(row) for row in content.rows)
    notes = "".join(f'<p class="note">{html.escape(note)}</p>' for note in content.notes)
    return (
        f'{heading(content.title)}\n<div class="scroll"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{rows}\n</tbody></table></div>{notes}"
    )


def _row(row: Sequence[str]) -> str:
    own = ' class="own"' if row[0].startswith("this run") else ""
    return f"<tr{own}>{''.join(f'<td>{_cell(cell)}</td>' for cell in row)}</tr>"


def _cell(text: str) -> str:
    return re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", html.escape(text, quote=False))
