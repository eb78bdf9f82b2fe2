"""The files for Docker, as far as they can be checked without it: they copy what is there and install what exists."""

import fnmatch
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "docker").glob("*.Dockerfile"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def instructions(file: Path) -> list[list[str]]:
    lines = file.read_text().replace("\\\n", " ").splitlines()
    return [line.split() for line in lines if line.strip() and not line.startswith("#")]


def copied(file: Path) -> list[str]:
    """What a file copies from the repository."""
    return [name.removesuffix("/") for words in instructions(file) if words[0] == "COPY" for name in words[1:-1]]


def admitted(name: str) -> bool:
    """Whether .dockerignore lets a name of the top folder through; the last pattern that fits decides."""
    result = True
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        if line and not line.startswith("#") and fnmatch.fnmatch(name, line.removeprefix("!")):
            result = line.startswith("!")
    return result


def test_there_is_one_for_each_kind_of_device() -> None:
    assert [file.name for file in FILES] == ["cpu.Dockerfile", "cuda.Dockerfile"]
    extras = {file.name: re.search(r"^ARG EXTRAS=(.*)$", file.read_text(), re.MULTILINE) for file in FILES}
    assert all(extras.values())
    chosen = {name: set(match[1].split(",")) for name, match in extras.items() if match}
    assert all(names <= PROJECT["optional-dependencies"].keys() for names in chosen.values())
    assert chosen["cuda.Dockerfile"] - chosen["cpu.Dockerfile"] == {"cuda"}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_what_is_copied_is_there_is_not_ignored_and_is_enough_to_build(file: Path) -> None:
    names = copied(file)
    ignored = [line.strip("/") for line in (ROOT / ".gitignore").read_text().split()]
    for name in names:
        assert (ROOT / name).exists()
        assert admitted(name)
        assert not any(fnmatch.fnmatch(name, pattern) for pattern in ignored)
    assert {"pyproject.toml", PROJECT["readme"], *PROJECT["license-files"], "logvggt_jax"} <= set(names)
    assert not admitted("runs") and not admitted(".venv")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_it_starts_the_command_as_an_ordinary_user(file: Path) -> None:
    found = {words[0]: words[1:] for words in instructions(file)}
    assert found["USER"] == ["logvggt"]
    assert found["ENTRYPOINT"] == ['["logvggt"]'] and "logvggt" in PROJECT["scripts"]
    python = re.fullmatch(r"python:(\d+\.\d+)-slim", found["FROM"][0])
    assert python and tuple(map(int, python[1].split("."))) >= (3, 11)
