"""What a result was computed with: versions, commit, device, checkpoint."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import jax

_VERSIONED = ("logvggt-jax", "jax", "jaxlib", "flax", "numpy", "scipy", "evo", "open3d", "opencv-python-headless")


def environment() -> dict[str, Any]:
    """`versions` by package, `commit` of this package's checkout (`unknown` where it is not one), `device`."""
    return {
        "versions": {name: _version(name) for name in _VERSIONED},
        "commit": _commit(Path(__file__).parent),
        "device": str(jax.devices()[0].device_kind),
    }


def describe_device() -> str:
    """The default device by name; of a CPU its model and cores, where the system tells."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return f"{device.device_kind} ({device.platform}), host with {os.cpu_count()} cores"
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores"


def checkpoint_identity(path: str | Path) -> str:
    """Digest of a model folder's description, which holds a digest of every parameter."""
    description = Path(path).expanduser() / "config.json"
    return hashlib.blake2b(description.read_bytes(), digest_size=16).hexdigest()


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
