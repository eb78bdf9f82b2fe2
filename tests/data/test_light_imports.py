"""Listing, opening and reading data sets loads neither JAX nor Grain, which take seconds."""

import subprocess
import sys
from pathlib import Path

from layouts.layout import VIEWS
from layouts.replica import write

SCRIPT = """
import sys
import logvggt_jax.data
from logvggt_jax.cli import main
from logvggt_jax.data import Frames, open_dataset

for name, root in (("replica", sys.argv[1]), ("rooms", None)):
    dataset = open_dataset(name, root)
    assert isinstance(dataset.read(dataset.sequences[0], [0]), Frames)
assert main(["data", "list"]) == main(["data", "check", "replica", sys.argv[1]]) == 0
loaded = {"jax", "jaxlib", "flax", "grain", "orbax"} & set(sys.modules)
assert not loaded, loaded
"""


def test_reading_data_loads_neither_jax_nor_grain(tmp_path: Path) -> None:
    write(tmp_path, VIEWS[:1])
    subprocess.run([sys.executable, "-c", SCRIPT, str(tmp_path)], check=True, capture_output=True, text=True)


def test_every_public_name_can_be_imported() -> None:
    import logvggt_jax
    import logvggt_jax.data

    for module in (logvggt_jax, logvggt_jax.data):
        assert all(getattr(module, name) is not None for name in module.__all__)
        assert set(module.__all__) <= set(dir(module))
