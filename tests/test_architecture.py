"""The package's layering: who may import whom, read from the source (CONTRIBUTING states the same rule)."""

import ast
import functools
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "logvggt_jax"

GROUND_FLOOR = {
    "types",
    "frames",
    "colours",
    "config",
    "files",
    "errors",
    "compile",
    "described",
    "operations",
    "interruption",
    "terminal",
    "page",
    "program_flags",
    "program_text",
}
# What each part may import besides itself and the ground floor.
ALLOWED: dict[str, set[str]] = {
    "geometry": set(),
    "metrics": {"geometry"},
    "model": {"geometry"},
    "data": {"geometry"},
    "weights": {"geometry", "model"},
    "streaming": {"geometry", "model", "weights"},
    "training": {"geometry", "metrics", "model", "data", "weights", "streaming"},
    "reconstruction": {"geometry", "model", "data", "weights", "streaming"},
    "evaluation": {"geometry", "metrics", "model", "data", "weights", "streaming"},
}
# What each folder of `training` may import of it besides itself and `config.py`; the files above them may import all.
TRAINING: dict[str, set[str]] = {
    "losses": set(),
    "parallel": set(),
    "reporting": set(),
    "step": {"losses", "parallel"},
    "feeding": {"parallel", "step"},
    "checkpoints": {"parallel", "step"},
    "teaching": {"parallel", "feeding"},
    "validation": {"parallel", "feeding"},
}
# `doctor` examines everything and is called by the command line alone.
ENTRY_POINTS = {"__init__", "__main__", "cli", "doctor"}


@functools.cache
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


def sources() -> dict[str, Path]:
    """Every module of the package by its dotted name."""
    return {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in sorted(PACKAGE.rglob("*.py"))}


def test_imports_go_one_way() -> None:
    wrong = []
    for name, path in sources().items():
        part = name.split(".")[1]
        if part in ENTRY_POINTS:
            continue
        others = {module.split(".")[1] for module in imported_modules(path)} - {part}
        allowed = set() if part in GROUND_FLOOR else ALLOWED[part]
        if forbidden := (others & {*ALLOWED, *ENTRY_POINTS}) - allowed:
            wrong.append(f"{name} imports {sorted(forbidden)}")
    assert not wrong, "\n".join(wrong)


def test_imports_go_one_way_between_the_folders_of_training() -> None:
    folders = {path.name for path in (PACKAGE / "training").iterdir() if (path / "__init__.py").exists()}
    assert folders == set(TRAINING)
    wrong = []
    for name, path in sources().items():
        part, *rest = name.split(".")[1:]
        if part == "training" and rest[0] in TRAINING:
            imported = {module.split(".")[2] for module in imported_modules(path) if ".training." in module}
            if forbidden := imported - {rest[0], "config"} - TRAINING[rest[0]]:
                wrong.append(f"{name} imports {sorted(forbidden)}")
    assert not wrong, "\n".join(wrong)


def test_rooms_are_a_data_set_like_any_other() -> None:
    """Only the registry, the public names and what writes a room to the disk import them; others open them by name."""
    knowing = {"logvggt_jax.data.registry", "logvggt_jax.data.__init__", "logvggt_jax.reconstruction.room_sequence"}
    others = {name: path for name, path in sources().items() if not name.startswith("logvggt_jax.data.rooms.")}
    found = {
        name
        for name, path in others.items()
        if any(module.startswith("logvggt_jax.data.rooms") for module in imported_modules(path))
    }
    assert found == knowing


def test_of_the_data_only_what_draws_on_the_device_imports_jax() -> None:
    importing = {
        name
        for name, path in sources().items()
        if name.startswith("logvggt_jax.data.")
        and any(re.match(r"\s*(import|from) jax\b", line) for line in path.read_text().splitlines())
    }
    assert importing == {"logvggt_jax.data.rooms.device_renderer"}


def test_there_are_no_import_circles_and_no_drawer_for_everything() -> None:
    modules = sources()
    assert not [name for name in modules if name.split(".")[-1] in {"utils", "util", "helpers", "misc", "common"}]
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
