"""One self-contained HTML page of tables, notes and pictures."""

import base64
import html
import re
from collections.abc import Sequence
from pathlib import Path

from logvggt_jax.errors import printable
from logvggt_jax.evaluation.report.tables import Table

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1200px; padding: 0 1rem; color: #222; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; white-space: nowrap; }
th, td { padding: 0.2rem 0.7rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
tr.own { background: #eef4fb; }
p.note, li { color: #555; font-size: 0.9rem; }
figure { margin: 1.5rem 0; } img { max-width: 100%; } figcaption { color: #555; font-size: 0.85rem; }
"""


def html_page(title: str, tables: Sequence[Table], notes: Sequence[str], pictures: Sequence[Path]) -> str:
    """The page as text; pictures (PNG files) are embedded, so that it can be sent and kept as one file."""
    parts = [
        "<!doctype html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>',
        f"<style>{_STYLE}</style></head><body>",
        f"<h1>{html.escape(title)}</h1>",
        *(_table(table) for table in tables),
        "<h2>Notes</h2><ul>",
        *(f"<li>{html.escape(note)}</li>" for note in notes),
        "</ul>",
        *(["<h2>Figures</h2>"] if pictures else []),
        *(_figure(path) for path in pictures),
        "</body></html>",
    ]
    return "\n".join(parts) + "\n"


def _table(table: Table) -> str:
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in table.header)
    rows = "\n".join(_row(row) for row in table.rows)
    notes = "".join(f'<p class="note">{html.escape(note)}</p>' for note in table.notes)
    return (
        f'<h2>{html.escape(table.title)}</h2>\n<div class="scroll"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{rows}\n</tbody></table></div>{notes}"
    )


def _row(row: Sequence[str]) -> str:
    own = ' class="own"' if row[0].startswith("this run") else ""
    return f"<tr{own}>{''.join(f'<td>{_cell(cell)}</td>' for cell in row)}</tr>"


def _cell(text: str) -> str:
    return re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", html.escape(text, quote=False))


def _figure(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    name = html.escape(printable(path.stem))
    return f'<figure><img alt="{name}" src="data:image/png;base64,{data}"><figcaption>{name}</figcaption></figure>'
