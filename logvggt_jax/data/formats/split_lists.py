"""Lists of a split's sequences, where a copy of the set need not be complete."""

from collections.abc import Collection, Iterable
from pathlib import Path

from logvggt_jax.data.formats.source_files import SourceFiles


def sequences_present(listed: Iterable[str], present: Collection[str], where: Path, files: SourceFiles) -> list[str]:
    """Sorted names that the list file `where` has and that are `present`.

    Sets of terabytes come in parts, so that a listed sequence may lack its folder; how many do is remarked to `files`.
    """
    wanted = sorted(set(listed))
    found = [name for name in wanted if name in present]
    if len(found) < len(wanted):
        absent = next(name for name in wanted if name not in present)
        files.remark(
            f"{where} lists {len(wanted)} sequences, {len(wanted) - len(found)} of them are not there and left out, "
            f"for example {absent}"
        )
    return found
