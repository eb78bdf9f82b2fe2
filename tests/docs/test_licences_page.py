"""The page of licences says what the code knows: data sets, models that ship, and extras."""

import itertools
import tomllib

from licence_table import PAGE, with_table
from shell_lines import ROOT


def test_the_table_of_data_sets_is_what_the_readers_say() -> None:
    page = PAGE.read_text()
    assert with_table(page) == page, "run python scripts/licence_table.py"
    assert with_table(page.replace("| `spring` |", "| `autumn` |")) == page, "and that is what it writes"


def test_every_extra_with_a_licence_of_its_own_is_named() -> None:
    lines = (ROOT / "pyproject.toml").read_text().splitlines()
    agreed = {after.partition(" = ")[0] for line, after in itertools.pairwise(lines) if "agrees" in line}
    extras = tomllib.loads("\n".join(lines))["project"]["optional-dependencies"]
    assert {"eval", "video"} <= agreed <= set(extras)
    software = PAGE.read_text().partition("## Software")[2]
    assert [name for name in sorted(agreed) if f"| `{name}` |" not in software] == []
