"""JSON files that may be damaged."""

import json
from pathlib import Path
from typing import Any

from logvggt_jax.errors import InputError, one_line
from logvggt_jax.files import open_regular


def read_json(path: Path, mend: str) -> Any:
    """What a JSON file holds. Raises InputError ending in `mend` where it is no JSON, others as `open_regular`."""
    with open_regular(path) as stream:
        content = stream.read()
    try:
        return json.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({one_line(error):.200}); {mend}") from error
