"""What a plain `pip install` brings may be distributed with an Apache-2.0 package: none of it is under the GPL.

The LGPL is allowed, since its libraries may be used by programs under other licences. evo (GPL) is in the extra `eval`,
PyAV, whose wheels bundle FFmpeg with parts under the GPL, in the extra `video`, pycolmap, whose wheels bundle CHOLMOD
with parts under the GPL, in the extra `colmap`.
"""

import re
import tomllib
from collections.abc import Iterator
from email.message import Message
from importlib.metadata import Distribution, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]


def licences(metadata: Message) -> list[str]:
    """The licence as the expression, else the classifiers, else the first line of the free text."""
    expression = metadata.get("License-Expression")
    classifiers = [line for line in metadata.get_all("Classifier") or [] if line.startswith("License ::")]
    text = (metadata.get("License") or "").strip().splitlines()[:1]
    return [expression] if expression else classifiers or text


def is_gpl(metadata: Message) -> bool:
    """Whether GPL or AGPL terms apply to all of it."""

    def names_gpl(text: str) -> bool:
        lesser = re.sub(r"LGPL|(GNU )?(Lesser|Library) General Public", "", text, flags=re.IGNORECASE)
        return re.search(r"GPL|General Public", lesser, flags=re.IGNORECASE) is not None

    stated = [part for text in licences(metadata) for part in text.split(" OR ")]
    return bool(stated) and all(names_gpl(part) for part in stated)


def installed(requirements: list[str]) -> Iterator[Distribution]:
    """The distributions that these requirements bring on this machine, and what those bring."""
    todo = [Requirement(text) for text in requirements]
    seen = set()
    while todo:
        requirement = todo.pop()
        for extra in ("", *requirement.extras):
            if (requirement.name, extra) in seen:
                continue
            seen.add((requirement.name, extra))
            found = distribution(requirement.name)
            needed = [Requirement(text) for text in found.requires or ()]
            todo += [each for each in needed if each.marker is None or each.marker.evaluate({"extra": extra})]
            yield found


def test_nothing_that_a_plain_install_brings_is_gpl() -> None:
    found = {each.metadata["Name"]: each.metadata for each in installed(PROJECT["dependencies"])}
    assert {"jax", "jaxlib", "numpy", "pillow", "tensorstore"} <= found.keys(), "what dependencies bring is looked at"
    assert [name for name, metadata in found.items() if is_gpl(metadata)] == []
    assert [name for name, metadata in found.items() if not licences(metadata)] == [], "no licence stated"


@pytest.mark.parametrize(("package", "extra"), [("evo", "eval"), ("av", "video"), ("pycolmap", "colmap")])
def test_what_brings_gpl_stays_in_its_extra(package: str, extra: str) -> None:
    extras = {
        name: {Requirement(text).name for text in texts} for name, texts in PROJECT["optional-dependencies"].items()
    }
    assert [name for name, needed in extras.items() if package in needed] == [extra]
    assert package not in {Requirement(text).name for text in PROJECT["dependencies"]}


@pytest.mark.parametrize(
    ("field", "value", "gpl"),
    [
        ("License-Expression", "GPL-3.0-or-later", True),
        ("License-Expression", "AGPL-3.0-only", True),
        ("License-Expression", "MIT OR GPL-2.0-only", False),
        ("License-Expression", "LGPL-3.0-or-later", False),
        ("Classifier", "License :: OSI Approved :: GNU General Public License v3 (GPLv3)", True),
        ("Classifier", "License :: OSI Approved :: GNU Lesser General Public License v3 (LGPLv3)", False),
        ("License", "GNU GENERAL PUBLIC LICENSE\nVersion 3, 29 June 2007", True),
        ("License", "BSD 3-Clause\nBundles libgfortran, GPL with the runtime exception", False),
    ],
)
def test_licences_are_told_apart(field: str, value: str, gpl: bool) -> None:
    metadata = Message()
    metadata[field] = value
    assert is_gpl(metadata) == gpl
