"""What a wheel of this package holds: every file that is not code is declared, and all of it stays small.

The wheel is built from the source distribution, as an index's user may have to, installed, and used.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "logvggt_jax"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGE_DATA = PROJECT["tool"]["setuptools"]["package-data"]


def declared() -> set[Path]:
    """The files that `package-data` names."""
    found = set()
    for package, patterns in PACKAGE_DATA.items():
        folder = ROOT / package.replace(".", "/")
        for pattern in patterns:
            found |= set(folder.glob(pattern))
    return found


def test_every_file_beside_the_code_is_in_the_wheel() -> None:
    files = {path for path in PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    beside = {path for path in files if path.suffix != ".py"}
    assert PACKAGE / "doctor" / "parity.npz" in beside
    assert beside <= declared()


def test_a_shipped_models_files_would_be_in_the_wheel() -> None:
    folder, patterns = PACKAGE / "weights" / "shipped" / "rooms", PACKAGE_DATA["logvggt_jax.weights"]
    for name in ("config.json", "params.safetensors"):
        assert any((folder / name).relative_to(PACKAGE / "weights").match(pattern) for pattern in patterns)


def test_the_wheel_stays_below_20_megabytes() -> None:
    assert sum(path.stat().st_size for path in {*declared(), *PACKAGE.rglob("*.py")}) < 20e6


def run(*command: str, cwd: Path, **environment: str) -> str:
    """Standard output of a command that must succeed."""
    done = subprocess.run(
        command,
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def build(kind: str, source: Path, into: Path) -> Path:
    """A distribution of the package in `source`, built without network by the build system that is installed."""
    program = f"import sys; from setuptools import build_meta; build_meta.build_{kind}(sys.argv[1])"
    run(sys.executable, "-c", program, str(into), cwd=source)
    (built,) = into.glob("*.tar.gz" if kind == "sdist" else "*.whl")
    return built


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    needed = Requirement(PROJECT["build-system"]["requires"][0])
    try:
        there = version(needed.name)
    except PackageNotFoundError:
        pytest.skip(f"needs {needed}")
    if there not in needed.specifier:
        pytest.skip(f"needs {needed}, here is {there}")
    folder = tmp_path_factory.mktemp("sdist")
    # A build writes beside the code; and what git ignores must not be what makes it work.
    ignored = [line.strip("/") for line in (ROOT / ".gitignore").read_text().split()]
    shutil.copytree(ROOT, folder / "source", ignore=shutil.ignore_patterns(".git", *ignored))
    return build("sdist", folder / "source", folder)


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    return build("wheel", folder / sdist.name.removesuffix(".tar.gz"), folder)


def test_the_source_distribution_holds_what_the_readme_runs(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for name in ("train.py", "eval.py", "Makefile", "configs/eval/paper.py", "tests/conftest.py", "docs/index.md"):
        assert name in names
    assert not [name for name in names if "__pycache__" in name]


def test_the_wheel_holds_the_package_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    files = {path for path in PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    assert names == {path.relative_to(ROOT).as_posix() for path in files}


def test_the_wheel_is_installed_and_used(wheel: Path, tmp_path: Path) -> None:
    place = tmp_path / "installed"
    options = ["--quiet", "--no-deps", "--no-index", "--no-compile", "--disable-pip-version-check"]
    run(sys.executable, "-m", "pip", "install", *options, "--target", str(place), str(wheel), cwd=tmp_path)
    command, path = str(place / "bin" / "logvggt"), {"PYTHONPATH": str(place)}
    program = "import logvggt_jax.cli; print(logvggt_jax.cli.__file__)"
    assert Path(run(sys.executable, "-c", program, cwd=tmp_path, **path).strip()).is_relative_to(place)
    assert "reconstruct" in run(command, "--help", cwd=tmp_path, **path)
    assert run(command, "--version", cwd=tmp_path, **path) == f"logvggt {PROJECT['project']['version']}\n"
    assert "scannet: ScanNet" in run(command, "data", "list", cwd=tmp_path, **path)
    # The weights are in it, whole.
    assert "every parameter is finite and equals the digest" in run(command, "info", "rooms", cwd=tmp_path, **path)
