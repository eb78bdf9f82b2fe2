"""What options can be chosen from: the keys of the registries, read in their source, since importing loads JAX."""

import ast
from pathlib import Path


def _keys(file: str, registry: str) -> tuple[str, ...]:
    """The keys of the dict `registry` that a file of this package assigns."""
    for node in ast.parse((Path(__file__).parents[1] / file).read_text("utf-8")).body:
        if (
            isinstance(node, ast.AnnAssign)
            and isinstance(node.value, ast.Dict)
            and ast.unparse(node.target) == registry
        ):
            return tuple(ast.literal_eval(key) for key in node.value.keys if key is not None)
    raise LookupError(f"{file} assigns no dict {registry}")


METHOD_NAMES = _keys("streaming/predictor.py", "METHODS")
FORMATS = _keys("reconstruction/exporters/__init__.py", "EXPORTERS")
