"""What names hold is text in every form of a report: no markup, no HTML, no command to a terminal."""

import io
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from logvggt_jax.errors import printable
from logvggt_jax.evaluation.report.captions import caption, summary
from logvggt_jax.evaluation.report.report import print_report, write_report

HOSTILE = [
    "<script>alert(1)</script>",
    "a|b",
    "[/x][red]",
    "![](https://example.org/x.png)",
    "a`b\\c",
    "clear\x1b[2J\x07",
    "two\nlines\n# title",
    ":warning:",
    os.fsdecode(b"caf\xe9"),
]


def results(name: str) -> dict[str, Any]:
    """Results of one benchmark in which all that a user can name has this name."""
    where = {"benchmark": "rooms-clips-4", "frames": 4, "method": name}
    return {
        "title": name,
        "command": f"python eval.py {name}",
        "checkpoint": "",
        "methods": [{"name": name, "knows": name, "static": False}],
        "benchmarks": [
            {
                "name": "rooms-clips-4",
                "title": name,
                "dataset": name,
                "missing": "",
                "frames": name,
                "images": "28 x 42",
                "decisions": [name],
                "settings": {"points": None},
            }
        ],
        "summary": [{**where, "scale/abs_rel": 0.5, "clips": 1, "clips_depth": 1, "clips_measured": 1}],
        "skipped": [{**where, "sequence": name, "reason": f"/data/{name}: no such file"}],
        "failures": [{**where, "sequence": name, "metric": "depth", "reason": name}],
        "figures": [],
        "environments": [],
    }


class Page(HTMLParser):
    """Elements and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: set[str] = set()
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.elements.add(tag)

    def handle_data(self, data: str) -> None:
        self.text += data


def obeyed(text: str) -> bool:
    """Whether a terminal would do anything but show this."""
    return not text.replace("\n", "").isprintable()


@pytest.mark.parametrize("name", HOSTILE)
def test_names_are_text_in_markdown_html_and_on_the_terminal(name: str, tmp_path: Path) -> None:
    made = results(name)
    write_report(made, tmp_path)
    plain, hostile = Page((tmp_path / "report.html").read_text()), tmp_path / "plain"
    hostile.mkdir()
    write_report(results("a name"), hostile)
    expected = Page((hostile / "report.html").read_text())
    assert plain.elements == expected.elements and not obeyed(plain.text)
    assert plain.text.count("0.5000") == 1 and printable(name) in plain.text

    markdown, usual = ((folder / "report.md").read_text() for folder in (tmp_path, hostile))
    assert not obeyed(markdown) and len(markdown.splitlines()) == len(usual.splitlines())
    # Outside of code nothing is left that Markdown reads as its own; and rows have the columns of their heads.
    text, _, _ = markdown.partition("\n    python eval.py")
    assert not re.search(r"(?<!\\)(\\\\)*[`<>\[\]]", text)
    table = [line.replace(r"\|", "") for line in markdown.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in table} == {usual.splitlines()[4].count("|")}

    print_report(made, Console(file=(terminal := io.StringIO()), width=400))
    assert not obeyed(terminal.getvalue()) and printable(name) in terminal.getvalue()


def test_control_characters_reach_no_terminal_with_colours(tmp_path: Path) -> None:
    print_report(results("clear\x1b[2J"), Console(file=(terminal := io.StringIO()), force_terminal=True, width=400))
    assert r"clear\x1b[2J" in terminal.getvalue() and "\x1b[2J" not in terminal.getvalue()


def test_the_page_begins_with_a_summary_and_marks_the_first_row(tmp_path: Path) -> None:
    made = results("ours")
    made["methods"].append({"name": "theirs", "knows": "nothing", "static": False})
    made["summary"].append({**made["summary"][0], "method": "theirs", "scale/abs_rel": 0.25})
    rank = "ours is number 2 of 2 rows by Abs Rel (scale), 0.5000; the best is theirs with 0.2500."
    assert summary(made)[1] == f"ours: {rank}"
    write_report(made, tmp_path)
    text = (tmp_path / "report.html").read_text()
    assert text.index("Summary") < text.index(rank) < text.index("<table>")
    assert re.findall(r'<tr class="own"><td>(.*?)</td>', text) == ["ours"]


def test_captions_are_words() -> None:
    words = caption("rooms_a_b_from_3_24_frames_0123abcd_trajectory")
    assert words.startswith("rooms_a_b, 24 frames from frame 3 on: true and predicted camera positions")
    assert caption("ate_against_views_tum") == "Ate against views tum."
