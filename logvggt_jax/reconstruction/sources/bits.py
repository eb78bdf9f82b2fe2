"""Numbers of any count of bits, as the headers of codecs hold them."""

from __future__ import annotations

# What stands in units of H.264 and HEVC for two zeros before a byte with which they would be a start code.
_ESCAPED = b"\0\0\3"


class Bits:
    """Bits of `content` from its beginning on, of which those beyond its end are 0."""

    def __init__(self, content: bytes) -> None:
        self._bits = int.from_bytes(content, "big")
        self._left = 8 * len(content)

    @classmethod
    def unescaped(cls, content: bytes) -> Bits:
        """Bits of a part of a unit of H.264 or HEVC."""
        return cls(content.replace(_ESCAPED, _ESCAPED[:2]))

    def take(self, count: int) -> int:
        """The next bits as a number."""
        self._left -= count
        value = self._bits >> self._left if self._left >= 0 else 0
        return value & ((1 << count) - 1)

    def number(self) -> int:
        """A number whose zeros before it tell its length (ITU-T H.264, 9.1)."""
        zeros = 0
        while self._left > 0 and zeros < 32 and not self.take(1):
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)
