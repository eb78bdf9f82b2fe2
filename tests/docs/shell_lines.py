"""The commands that the documentation shows, read from its Markdown."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("docs/*.sbatch")])
_BLOCK = re.compile(r"^```(?P<language>\w*)\n(?P<text>.*?)^```", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"(?<!`)`([^`]+)`(?!`)")
_PROGRAMS = ("logvggt", "train.py", "eval.py")
_IMAGE = re.compile(r"logvggt-jax:\w+")


class Command(NamedTuple):
    """One command of a page.

    Attributes:
      page: name of its file.
      program: `logvggt`, `train.py` or `eval.py`.
      arguments: the words after it.
      whole: False where the page leaves something out (`…`), or names a command within a sentence.
    """

    page: str
    program: str
    arguments: tuple[str, ...]
    whole: bool


def commands(pages: list[Path] = PAGES) -> list[Command]:
    """Every command of these pages that runs this package; what several show belongs to the last."""
    found = [command for page in pages for command in _commands(page)]
    return list({command[1:]: command for command in found}.values())


def blocks(page: Path, language: str) -> list[str]:
    """The text of a page's code blocks in this language."""
    return [match["text"] for match in _BLOCK.finditer(page.read_text()) if match["language"] == language]


def shell_lines(page: Path) -> Iterator[list[str]]:
    """The words of every line of shell on a page, without comments."""
    texts = [page.read_text()] if page.suffix != ".md" else blocks(page, "sh")
    for text in texts:
        for line in text.replace("\\\n", " ").splitlines():
            if words := shlex.split(line, comments=True):
                yield words


def _commands(page: Path) -> Iterator[Command]:
    for words in shell_lines(page):
        if found := _called(words):
            program, arguments = found
            yield Command(page.name, program, arguments, whole="…" not in arguments)
    if page.suffix == ".md":
        for match in _INLINE.finditer(_BLOCK.sub("", page.read_text())):
            words = " ".join(match[1].split()).split(" ")
            if words[0] in _PROGRAMS and len(words) > 1:
                yield Command(page.name, words[0], tuple(words[1:]), whole=False)


def _called(words: list[str]) -> tuple[str, tuple[str, ...]] | None:
    """The program of this package that a line of shell runs, and its arguments."""
    for position, word in enumerate(words):
        program = "logvggt" if words[0] == "docker" and words[1] == "run" and _IMAGE.fullmatch(word) else word
        if program in _PROGRAMS and (position == 0 or words[position - 1] == "python" or program != word):
            return program, tuple(words[position + 1 :])
    return None
