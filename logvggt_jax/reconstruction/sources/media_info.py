"""What the header of a video says, read by MediaInfo: for OpenCV, which tells little of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from pymediainfo import MediaInfo

# Formats whose header states how long each frame is shown.
_STATE_EACH_DURATION = ("MPEG-4", "QuickTime", "AVI")
_HDR_TRANSFERS = ("PQ", "HLG")


@dataclasses.dataclass(frozen=True)
class MediaHeader:
    """What MediaInfo knows of the videos in a file.

    Attributes:
      sizes: (H, W) of each as it is stored, cover pictures left out.
      numbers: of each among all streams of the file.
      seconds: duration of the first; None where the last frame may be shown for most of it, which only its packet
        tells, unless the file is cut off.
      quarter_turns: by which the first is turned clockwise before it is shown, as a tag of the file says.
      interlaced: the header says of every frame that its lines show two moments in alternation.
      transfer: PQ or HLG, as HDR is coded; None for neither.
    """

    sizes: list[tuple[int, int]]
    numbers: list[int]
    seconds: float | None
    quarter_turns: int
    interlaced: bool
    transfer: str | None


def read_media_header(path: Path) -> MediaHeader | None:
    """None where MediaInfo's library is not there for this system, or knows nothing of the file's videos."""
    if not MediaInfo.can_parse():
        return None
    try:
        information = MediaInfo.parse(str(path))
    except (OSError, RuntimeError):
        return None
    videos = information.video_tracks
    if not videos:
        return None
    first, file = videos[0], information.general_tracks[0]
    known = file.format in _STATE_EACH_DURATION or file.istruncated == "Yes"
    duration = _number(first.duration) if known else None
    return MediaHeader(
        sizes=[(round(_number(each.height) or 0), round(_number(each.width) or 0)) for each in videos],
        numbers=[round(_number(each.stream_identifier) or 0) for each in videos],
        seconds=duration and duration / 1000,
        quarter_turns=round((_number(first.rotate) or 0) / 90) % 4,
        interlaced=first.scan_type == "Interlaced",
        transfer=next((each for each in _HDR_TRANSFERS if first.transfer_characteristics == each), None),
    )


def _number(value: Any) -> float | None:
    """A number that MediaInfo gives as one, or as text; None for 0, which stands for none."""
    try:
        return float(value) or None
    except (TypeError, ValueError):
        return None
