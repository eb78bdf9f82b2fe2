"""Writes the table of data sets in docs/licences.md anew, from what the readers say.

python scripts/licence_table.py
"""

import re
from pathlib import Path

from logvggt_jax.data.registry import READERS

PAGE = Path(__file__).parents[1] / "docs" / "licences.md"
_HEAD = "| name | data set | for | licence |\n|---|---|---|---|\n"


def with_table(page: str) -> str:
    """The page with the table as the readers have it."""
    rows = [
        f"| `{name}` | {reader.title} | {' and '.join(reader.about.roles)} | {reader.about.licence} |\n"
        for name, reader in READERS.items()
    ]
    before, after = re.split(re.escape(_HEAD) + r"(?:\|.*\n)*", page)
    return before + _HEAD + "".join(rows) + after


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
