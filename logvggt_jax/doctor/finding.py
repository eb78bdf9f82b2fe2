"""One line of the doctor's report."""

from __future__ import annotations

import dataclasses
import json

UNFINISHED = "unfinished"
"""The value of a part that its time did not suffice for: nothing is known to be wrong, nor to be right."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """What a part found.

    Attributes:
      part: name of the part.
      what: what was looked at.
      value: a number in `unit`, a text, or None where there is none to be had.
      unit: of a number.
      ok: False where something is wrong, True where it was checked and is right, None where nothing was judged.
      note: the bound, the condition, or the mend.
    """

    part: str
    what: str
    value: float | str | None
    unit: str = ""
    ok: bool | None = None
    note: str = ""

    def to_json(self) -> str:
        """One line."""
        return json.dumps(dataclasses.asdict(self))

    def value_text(self) -> str:
        """For a table; a value that is not there is a dash, never a zero."""
        if self.value is None:
            return "-"
        number = f"{self.value:,.4g}" if isinstance(self.value, float) else str(self.value)
        return f"{number} {self.unit}".strip()
