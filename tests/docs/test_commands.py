"""Every command that README and documentation show is one that its program takes; none of them is run."""

import argparse
import re
import runpy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from absl import app, flags
from absl.testing import flagsaver
from shell_lines import PAGES, ROOT, Command, commands, shell_lines

from logvggt_jax import ModelConfig
from logvggt_jax.cli.program import command_parser, with_dashes
from logvggt_jax.weights.checkpoints import save_model
from logvggt_jax.weights.provenance import Provenance

# ml_collections loads configurations by a method that newer versions of Python do not have.
pytestmark = pytest.mark.filterwarnings("ignore:the load_module:DeprecationWarning")
COMMANDS = commands()
SCRIPTS = ("train.py", "eval.py")


def chosen(*programs: str, whole: bool) -> pytest.MarkDecorator:
    """Runs a test for each command of these programs."""
    found = [each for each in COMMANDS if each.program in programs and each.whole == whole]
    return pytest.mark.parametrize("command", found, ids=[f"{each.page}: {' '.join(each.arguments)}" for each in found])


@pytest.fixture(scope="module")
def small_model(small_config: ModelConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model folder whose description alone is a model's: configurations do not look at parameters."""
    folder = tmp_path_factory.mktemp("weights") / "model"
    save_model(folder, small_config, {"any": np.zeros(1, np.float32)}, Provenance("vggt", 42))
    return folder


@pytest.fixture
def parse_flags(
    small_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str, tuple[str, ...]], None]]:
    """Reads a script's command line as the script does, with its configuration, and goes no further."""

    def parse(script: str, arguments: tuple[str, ...]) -> None:
        # The libraries of configurations look for overrides there.
        monkeypatch.setattr(sys, "argv", [script, *arguments])
        rest: list[str] = []

        def read(_: Callable, flags_parser: Callable[[list[str]], list[str]]) -> None:
            rest.extend(flags_parser(sys.argv)[1:])

        monkeypatch.setattr(app, "run", read)
        with flagsaver.flagsaver():  # removes the script's own again
            runpy.run_path(str(ROOT / script), run_name="__main__")
        assert not rest, f"unknown arguments: {rest}"

    # Beside the configurations lies what they start from, which some look at: here one small model for all.
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    for command in COMMANDS:
        for path in re.findall(r"--config=\S+\.py:([^/\s]\S*)", " ".join(command.arguments)):
            if not (tmp_path / path).is_symlink():
                (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
                (tmp_path / path).symlink_to(small_model)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT))
    parsed = flags.FLAGS.is_parsed()
    yield parse
    if not parsed:
        flags.FLAGS.unparse_flags()


@chosen("logvggt", whole=True)
def test_logvggt_takes_the_command(command: Command) -> None:
    command_parser().parse_args(with_dashes(command.arguments))


@chosen("logvggt", whole=False)
def test_logvggt_has_the_command_and_options_that_a_sentence_names(command: Command) -> None:
    parser = command_parser()
    for word in command.arguments:
        groups = [each for each in parser._actions if isinstance(each, argparse._SubParsersAction)]
        if word.startswith("--"):
            assert word.partition("=")[0] in parser._option_string_actions
        elif groups and word not in ("COMMAND", "…"):
            assert word in groups[0].choices
            parser = groups[0].choices[word]


@chosen(*SCRIPTS, whole=True)
def test_a_script_takes_the_command(command: Command, parse_flags: Callable[[str, tuple[str, ...]], None]) -> None:
    parse_flags(command.program, command.arguments)


@chosen(*SCRIPTS, whole=False)
def test_a_script_has_the_flags_that_a_sentence_names(command: Command) -> None:
    defined = re.findall(r'DEFINE_\w+\(\s*"(\w+)"', (ROOT / command.program).read_text())
    names = [word.removeprefix("--").partition("=")[0] for word in command.arguments if word.startswith("--")]
    assert [name for name in names if name.partition(".")[0] not in defined] == []


@pytest.mark.parametrize(
    ("script", "arguments"),
    [
        ("train.py", ("--config=configs/tiny.py", "--workdir=x", "--no_such_flag")),
        ("train.py", ("--config=configs/tiny.py", "--workdir=x", "--config.optimizer.no_such_field=1")),
        ("train.py", ("--config=configs/tiny.py",)),
        ("eval.py", ("--config=configs/eval/no_such_file.py", "--checkpoint=x", "--output=y")),
        ("eval.py", ("--config=configs/eval/rooms.py", "--output=y")),
    ],
)
def test_what_a_script_would_refuse_is_noticed(
    script: str, arguments: tuple[str, ...], parse_flags: Callable[[str, tuple[str, ...]], None]
) -> None:
    before = set(flags.FLAGS)
    with pytest.raises(SystemExit):
        parse_flags(script, arguments)
    assert set(flags.FLAGS) == before


def test_commands_are_found_wherever_a_page_may_show_them(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "Say `logvggt data\nlist` or `train.py --dry_run`.\n\n"
        "```sh\nsrun -n 2 \\\n  python train.py --config=a  # b\ndocker run -v x logvggt-jax:cpu view y\n"
        "logvggt reconstruct … --fps 3\n```\n"
    )
    assert {(each.program, each.arguments, each.whole) for each in commands([page])} == {
        ("logvggt", ("data", "list"), False),
        ("train.py", ("--dry_run",), False),
        ("train.py", ("--config=a",), True),
        ("logvggt", ("view", "y"), True),
        ("logvggt", ("reconstruct", "…", "--fps", "3"), False),
    }


def test_every_script_and_target_that_a_page_runs_is_there() -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for page in PAGES:
        for words in shell_lines(page):
            scripts = [word for word in words if word.endswith(".py") and not word.startswith("-")]
            assert [script for script in scripts if not (ROOT / script).is_file()] == []
            if words[0] == "make":
                assert words[1] in targets
