"""A report as one HTML page: tables, notes and pictures."""

import html
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from logvggt_jax.evaluation.report.tables import Table
from logvggt_jax.page import document, figure, heading


def html_page(
    title: str,
    summary: Sequence[str],
    tables: Sequence[Table],
    notes: Sequence[str],
    pictures: Mapping[Path, str],
    own: str,
) -> str:
    """A report as text: a summary, tables, notes, and pictures (PNG files) over their captions.

    Rows that begin with `own`, or with the words of the paper's tables for this run's, are marked.
    """
    parts = [
        heading("Summary"),
        f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in summary)}</ul>",
        *(table(each, own) for each in tables),
        heading("Notes"),
        f"<ul>{''.join(f'<li>{html.escape(note)}</li>' for note in notes)}</ul>",
        *([heading("Figures")] if pictures else []),
        *(figure(path, caption) for path, caption in pictures.items()),
    ]
    return document(title, parts)


def table(content: Table, own: str = "") -> str:
    """A table under its title, its notes below; rows that begin with `own` are marked."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in content.header)
    rows = "\n".join(_row(row, own) for row in content.rows)
    notes = "".join(f'<p class="note">{html.escape(note)}</p>' for note in content.notes)
    return (
        f'{heading(content.title)}\n<div class="scroll"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{rows}\n</tbody></table></div>{notes}"
    )


def _row(row: Sequence[str], own: str) -> str:
    marked = ' class="own"' if row[0].startswith("this run") or (own and row[0] == own) else ""
    return f"<tr{marked}>{''.join(f'<td>{_cell(cell)}</td>' for cell in row)}</tr>"


def _cell(text: str) -> str:
    return re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", html.escape(text, quote=False))
