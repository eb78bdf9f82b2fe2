"""Whether a JPEG holds what its picture is decoded from (ITU-T T.81, annex B)."""

from __future__ import annotations

_PREFIX, _SCAN, _END = 0xFF, 0xDA, 0xD9
# Markers without a length: what stands for none, restarts, and beginnings.
_ALONE = (0x01, *range(0xD0, 0xD9))


def holds_scan(jpeg: bytes) -> bool:
    """Whether a scan begins in it. FFmpeg takes one without for decoded, and shows what was in memory before."""
    place = 2
    while place + 4 <= len(jpeg) and jpeg[place] == _PREFIX:
        marker = jpeg[place + 1]
        if marker in (_SCAN, _END):
            break
        if marker == _PREFIX:
            place += 1
        elif marker in _ALONE:
            place += 2
        else:
            place += 2 + int.from_bytes(jpeg[place + 2 : place + 4], "big")
    # Behind a damaged segment decoders look for the next marker.
    return bytes((_PREFIX, _SCAN)) in jpeg[place:]
