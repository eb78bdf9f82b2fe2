"""Self-contained HTML pages of text and pictures, which open in a browser without a server."""

import base64
import html
from collections.abc import Sequence
from pathlib import Path

from logvggt_jax.errors import printable

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1200px; padding: 0 1rem; color: #222; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; white-space: nowrap; }
th, td { padding: 0.2rem 0.7rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
td:first-child, th:first-child { position: sticky; left: 0; background: #fff; }
tr.own, tr.own td:first-child { background: #e3eefb; } tr.own td:first-child { font-weight: 600; }
p.note, li { color: #555; font-size: 0.9rem; }
pre { background: #f5f5f5; padding: 0.6rem 0.8rem; overflow-x: auto; }
h1, h2, p, li, figcaption { overflow-wrap: anywhere; }
.drawings { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 480px), 1fr)); column-gap: 2rem; }
figure { margin: 1.5rem 0; } img { max-width: 100%; } figcaption { color: #555; font-size: 0.85rem; }
"""


def document(title: str, parts: Sequence[str]) -> str:
    """A whole page; its parts are HTML, as the functions below make it of plain text."""
    head = (
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title>",
        f"<style>{_STYLE}</style></head><body>",
        f"<h1>{html.escape(title)}</h1>",
    )
    return "\n".join([*head, *parts, "</body></html>"]) + "\n"


def heading(text: str) -> str:
    """The title of a section."""
    return f"<h2>{html.escape(text)}</h2>"


def paragraph(text: str) -> str:
    """Running text."""
    return f"<p>{html.escape(text)}</p>"


def command(text: str) -> str:
    """What to type in a terminal."""
    return f"<pre><code>{html.escape(text)}</code></pre>"


def figure(path: Path, caption: str) -> str:
    """A picture (a PNG file), embedded, so that the page can be sent and kept as one file."""
    data = base64.b64encode(path.read_bytes()).decode()
    text = html.escape(printable(caption))
    return f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'


def drawing(svg: str, caption: str) -> str:
    """A picture that is SVG text, embedded as it is."""
    return f"<figure>{svg}<figcaption>{html.escape(printable(caption))}</figcaption></figure>"


def side_by_side(drawings: Sequence[str]) -> str:
    """Small pictures, each of `drawing`, as many in a row as fit."""
    return f'<div class="drawings">{"".join(drawings)}</div>'
