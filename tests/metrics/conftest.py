"""The reference metrics' stored cases."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@pytest.fixture
def golden(golden_dir: Path, request: pytest.FixtureRequest) -> tuple[dict[str, Any], Any]:
    """Cases by name and their arrays, of the test file's FAMILY."""
    path = golden_dir / "metrics" / request.module.FAMILY
    cases = json.loads(path.with_suffix(".json").read_text())["cases"]
    return {case["id"]: case for case in cases}, np.load(path.with_suffix(".npz"))
