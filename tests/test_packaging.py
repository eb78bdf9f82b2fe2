"""What a wheel of this package holds: every file that is not code is declared, and all of it stays small."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "logvggt_jax"
PACKAGE_DATA = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]


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
