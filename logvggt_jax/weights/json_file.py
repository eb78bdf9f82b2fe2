"""JSON files that may be damaged."""

import json
from pathlib import Path
from typing import Any

from logvggt_jax.errors import InputError, disk_errors, one_line


def read_json(path: Path, mend: str) -> Any:
    """What a JSON file holds. Raises InputError ending in `mend` where it is no JSON, DiskError as `disk_errors`."""
    with disk_errors(path):
        content = path.read_bytes()
    try:
        return json.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({one_line(error):.200}); {mend}") from error
