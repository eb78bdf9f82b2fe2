"""What a result was computed with: versions, commit, code, device."""

import ast
import functools
import hashlib
import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import jax

_PACKAGE = Path(__file__).parents[1]
_VERSIONED = ("logvggt-jax", "jax", "jaxlib", "flax", "numpy", "scipy", "evo", "open3d", "opencv-python-headless")
# The files that decide a number once frames, images and measures are given. Not among them: the protocols, whose
# settings are in the key of every record and whose prose is nobody's number; reports; costs.
_DECIDING = (
    "types.py",
    "frames.py",
    "config.py",
    "geometry",
    "metrics",
    "model",
    "streaming",
    "data/dataset.py",
    "data/formats",
    "data/packed",
    "data/readers",
    "data/rooms",
    "data/feeding/transforms.py",
    "evaluation/clips.py",
    "evaluation/scores.py",
    "evaluation/methods",
    "evaluation/protocols/images.py",
)


def environment() -> dict[str, Any]:
    """`versions` by package, `commit` of this package's checkout (`unknown` where it is not one), `code`, `device`."""
    return {
        "versions": {name: _version(name) for name in _VERSIONED},
        "commit": _commit(Path(__file__).parent),
        "code": code_version(),
        "device": str(jax.devices()[0].device_kind),
    }


@functools.cache
def code_version(*more: str, package: Path = _PACKAGE) -> str:
    """Digest of the code that decides numbers; comments, docstrings and layout are not in it.

    `more` are files and folders of the `package` besides those that decide what is measured on a clip.
    """
    digest = hashlib.blake2b(digest_size=12)
    for part in (*_DECIDING, *more):
        for path in [package / part] if part.endswith(".py") else sorted((package / part).rglob("*.py")):
            tree = ast.parse(path.read_bytes())
            for node in ast.walk(tree):
                if (
                    isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
                    and ast.get_docstring(node) is not None
                ):
                    del node.body[0]
            digest.update(f"{path.relative_to(package)}\n{ast.dump(tree)}\n".encode())
    return digest.hexdigest()


def describe_device() -> str:
    """The default device by name; of a CPU its model and cores, where the system tells."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return f"{device.device_kind} ({device.platform}), host with {os.cpu_count()} cores"
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _commit(folder: Path) -> str:
    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True, timeout=20
        ).stdout.strip()

    try:
        # A package installed inside another project's checkout is not that project's commit.
        if not git("ls-files", "--error-unmatch", str(folder / "__init__.py")):
            return "unknown"
        return git("rev-parse", "HEAD") + (" with changes" if git("status", "--porcelain", str(folder.parent)) else "")
    except (OSError, subprocess.SubprocessError):
        return "unknown"
