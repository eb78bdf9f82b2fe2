"""The commands that `make demo` runs exist, as do the settings that they name."""

import functools
import importlib.util
import operator
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from ml_collections import config_dict

from logvggt_jax.cli.program import command_parser

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def commands() -> list[list[str]]:
    done = subprocess.run(
        ["make", "--no-print-directory", "-n", "demo"], cwd=ROOT, capture_output=True, text=True, check=True, timeout=60
    )
    return [shlex.split(line) for line in done.stdout.replace("\\\n", " ").splitlines()]


def test_the_demo_names_configurations_and_fields_that_exist(
    commands: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    scripts = []
    for words in commands:
        options = dict(word.removeprefix("--").split("=", 1) for word in words if word.startswith("--") and "=" in word)
        if "config" not in options:
            continue
        scripts += [word for word in words if word.endswith(".py") and not word.startswith("--")]
        spec = importlib.util.spec_from_file_location("configuration", ROOT / options["config"])
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        config = module.get_config()
        assert isinstance(config, config_dict.ConfigDict)
        for name in options:
            if name.startswith("config."):
                functools.reduce(operator.getitem, name.split(".")[1:], config)
    assert scripts == ["eval.py", "train.py"]


def test_the_demo_calls_the_command_line_as_it_is(commands: list[list[str]]) -> None:
    called = []
    for words in commands:
        for position, word in enumerate(words):
            if word.endswith("/logvggt"):
                command_parser().parse_args(words[position + 1 :])
                called.append(words[position + 1])
    assert called == ["render-room", "reconstruct"]


def test_the_demo_writes_its_page_from_what_it_has_made(commands: list[list[str]]) -> None:
    made = [word.rpartition("=")[2] for words in commands for word in words if "runs/demo/" in word]
    parts = [Path(path).name for path in made if Path(path).parent == Path("runs/demo")]
    assert set(parts) == {"room", "reconstruction", "evaluation", "training"}
    assert commands[-1][-2:] == ["scripts/demo_page.py", "runs/demo"] and (ROOT / commands[-1][-2]).is_file()


def test_the_demo_uses_the_model_that_ships(commands: list[list[str]]) -> None:
    given = []
    for words in commands:
        given += [words[i + 1] for i, word in enumerate(words) if word == "--checkpoint"]
        given += [word.partition("=")[2] for word in words if word.startswith("--checkpoint=")]
    assert given == ["rooms"] * 2


def test_cleaning_leaves_what_others_have_made(tmp_path: Path) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    for folder in (".venv", "runs/demo/room", "runs/test", "runs/test-all", "runs/site", "runs/h20/model"):
        (tmp_path / folder).mkdir(parents=True)
    subprocess.run(["make", "--no-print-directory", "clean"], cwd=tmp_path, capture_output=True, check=True, timeout=60)
    assert {path.name for path in tmp_path.iterdir()} == {"Makefile", "runs"}
    assert [path.relative_to(tmp_path / "runs").as_posix() for path in (tmp_path / "runs").rglob("*")] == [
        "h20",
        "h20/model",
    ]


def test_one_duration_of_the_demo_is_stated() -> None:
    assert "takes five to nine minutes on two cores" in (ROOT / "README.md").read_text()
    assert "README says how long it takes" in (ROOT / "Makefile").read_text()
    pages = [ROOT / name for name in ("README.md", "Makefile", "CONTRIBUTING.md", "scripts/demo_page.py")]
    for page in [*pages, *(ROOT / "docs").rglob("*.md")]:
        sentences = re.split(r"(?<=[.;:])\s", page.read_text())
        stated = [each for each in sentences if "make demo" in each and re.search(r"\bminutes?\b", each)]
        assert all("five to nine minutes" in each for each in stated), page
