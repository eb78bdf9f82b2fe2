"""The package's layering: who may import whom, read from the source."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "logvggt_jax"

# What each part may import besides itself.
ALLOWED = {
    "types": set(),
    "config": set(),
    "user_cache": set(),
    "geometry": set(),
    "model": {"types", "config", "geometry"},
    "data": {"types", "config", "user_cache", "geometry"},
    "weights": {"types", "config", "geometry", "model"},
    "training": {"types", "config", "geometry", "model", "weights", "data", "evaluation"},
    "inference": {"types", "config", "user_cache", "geometry", "model", "weights", "data"},
    "evaluation": {"types", "config", "geometry", "model", "weights", "data", "inference"},
}
ENTRY_POINTS = {"__init__", "__main__", "cli"}


def imported_modules(path: Path) -> set[str]:
    """Modules of this package that a file imports, wherever in the file."""
    modules = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            modules |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in modules if name.startswith("logvggt_jax.")}


def part_of(module: str) -> str:
    return module.split(".")[1]


def sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_one_way(path):
    part = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if part in ENTRY_POINTS:
        return
    parts = {part_of(module) for module in imported_modules(path)} - {part}
    known = parts & set(ALLOWED)
    assert known <= ALLOWED[part], f"{part} imports {sorted(known - ALLOWED[part])}"
    if part == "training" and path.stem != "validation":
        assert "evaluation" not in known, "only validation may call evaluation"


def test_there_are_no_import_circles():
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in sources()}
    graph = {name: {m for m in imported_modules(path) if m in modules and m != name} for name, path in modules.items()}
    finished: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail, name))
        if name not in finished:
            for target in sorted(graph[name]):
                visit(target, (*trail, name))
            finished.add(name)

    for name in graph:
        visit(name, ())


def test_there_is_no_drawer_for_everything():
    assert not [path for path in sources() if path.stem in {"utils", "util", "helpers", "misc", "common"}]
