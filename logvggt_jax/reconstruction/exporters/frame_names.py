"""Names of files for frames, which every reader of a format takes."""

from __future__ import annotations

from collections.abc import Sequence


def file_stems(names: Sequence[str]) -> list[str]:
    """Names without blanks and other characters that formats or shells take for something else; all differ.

    COLMAP's text files separate their fields with blanks. Letters and digits of any script stay, and so do `.`, `-`
    and `_`; names that nothing is wrong with stay as they are. They differ in more than capitals: Brush looks pictures
    up without regard to these, LichtFeld Studio refuses what only they tell apart, and Windows and macOS keep one file
    of two.
    """
    stems = ["".join(letter if letter.isalnum() or letter in ".-_" else "_" for letter in name) for name in names]
    kept = {stem.casefold() for stem, name in zip(stems, names, strict=True) if stem == name}
    taken = set(kept)
    unique = []
    for stem, name in zip(stems, names, strict=True):
        candidate, number = stem, 1
        if stem == name and stem.casefold() in kept:
            kept.remove(stem.casefold())
        else:
            while candidate.casefold() in taken:
                number += 1
                candidate = f"{stem}-{number}"
        taken.add(candidate.casefold())
        unique.append(candidate)
    return unique
