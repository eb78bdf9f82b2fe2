"""The models that ship inside the package, by name."""

from pathlib import Path

from logvggt_jax.errors import MissingInput
from logvggt_jax.weights.folder import is_model_folder, run_model

# `rooms`: the model of configs/rooms.py, procedural rooms at 56 x 70 pixels.
SHIPPED = ("rooms",)
ROOT = Path(__file__).parent / "shipped"


def shipped_model(name: str | Path) -> Path | None:
    """The folder of the model that ships under this name; None for anything else.

    What lies here under the name comes first if it is a model folder or the folder of a training run: a run in
    `--workdir=rooms` can be named as it was written. `./rooms`, or a `Path`, is never a shipped model.
    Raises MissingInput where the installation lacks the model.
    """
    if isinstance(name, Path) or name not in SHIPPED or is_model_folder(run_model(Path(name))):
        return None
    folder = ROOT / name
    if not is_model_folder(folder):
        raise MissingInput(
            f"{name}: the model that ships under this name is not in this installation ({folder} is not there); "
            "install the package from its wheel or its whole repository"
        )
    return folder
