"""Lists of a split's sequences, where a copy of the set need not be complete."""

from collections.abc import Collection, Iterable
from pathlib import Path

from absl import logging


def sequences_present(listed: Iterable[str], present: Collection[str], where: Path) -> list[str]:
    """Sorted names that the list file `where` has and that are `present`.

    Sets of terabytes come in parts, so that a listed sequence may lack its folder; how many do is logged.
    """
    wanted = sorted(set(listed))
    found = [name for name in wanted if name in present]
    if len(found) < len(wanted):
        absent = next(name for name in wanted if name not in present)
        logging.warning(
            "%s lists %d sequences, %d of them are not there and left out, for example %s",
            where,
            len(wanted),
            len(wanted) - len(found),
            absent,
        )
    return found
