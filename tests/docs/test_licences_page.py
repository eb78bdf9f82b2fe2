"""The page of licences says what the code knows: data sets, models that ship, and extras."""

import itertools
import tomllib

from shell_lines import ROOT

from logvggt_jax.data.registry import READERS

PAGE = (ROOT / "docs" / "licences.md").read_text()


def data_rows() -> str:
    """The table of data sets, as the page must have it."""
    rows = [
        f"| `{name}` | {reader.title} | {' and '.join(reader.about.roles)} | {reader.about.licence} |"
        for name, reader in READERS.items()
    ]
    return "\n".join(["| name | data set | for | licence |", "|---|---|---|---|", *rows]) + "\n"


def test_the_table_of_data_sets_is_what_the_readers_say() -> None:
    assert data_rows() in PAGE, f"docs/licences.md must hold\n\n{data_rows()}"


def test_every_extra_with_a_licence_of_its_own_is_named() -> None:
    lines = (ROOT / "pyproject.toml").read_text().splitlines()
    agreed = {after.partition(" = ")[0] for line, after in itertools.pairwise(lines) if "agrees" in line}
    extras = tomllib.loads("\n".join(lines))["project"]["optional-dependencies"]
    assert {"eval", "video"} <= agreed <= set(extras)
    software = PAGE.partition("## Software")[2]
    assert [name for name in sorted(agreed) if f"| `{name}` |" not in software] == []
