"""What the header of a video says, read by MediaInfo: for OpenCV, which tells little of it."""

from __future__ import annotations

import dataclasses
import queue
import threading
from pathlib import Path
from typing import Any

from pymediainfo import MediaInfo

# Formats whose header states how long each frame is shown.
_STATE_EACH_DURATION = ("MPEG-4", "QuickTime", "AVI")
_HDR_TRANSFERS = ("PQ", "HLG")
# Seconds; what is whole takes hundredths of one.
_PATIENCE = 5.0


@dataclasses.dataclass(frozen=True)
class MediaHeader:
    """What MediaInfo knows of the videos in a file.

    Attributes:
      sizes: (H, W) of each as it is stored, cover pictures left out.
      seconds: duration of the first; None where the last frame may be shown for most of it, which only its packet
        tells, unless the file is cut off.
      quarter_turns: by which the first is turned clockwise before it is shown, as a tag of the file says.
      interlaced: the header says of every frame that its lines show two moments in alternation.
      transfer: PQ or HLG, as HDR is coded; None for neither.
      bare: the file is a stream of a codec and nothing else, which states no times.
      rate: frames a second of the first; None where it is not known.
      sound: there is some.
    """

    sizes: list[tuple[int, int]]
    seconds: float | None
    quarter_turns: int
    interlaced: bool
    transfer: str | None
    bare: bool
    rate: float | None
    sound: bool


def media_info_is_there() -> bool:
    """Whether there is a library of MediaInfo for this system."""
    return bool(MediaInfo.can_parse())


def read_media_header(path: Path) -> MediaHeader | None:
    """None where there is no library, or it knows nothing of the file's videos, or takes more than seconds to say."""
    if not media_info_is_there():
        return None
    answer: queue.SimpleQueue[MediaInfo | None] = queue.SimpleQueue()
    threading.Thread(target=_parse, args=(path, answer), daemon=True, name="mediainfo").start()
    try:
        information = answer.get(timeout=_PATIENCE)
    except queue.Empty:  # some damaged files are searched for minutes
        return None
    if information is None:
        return None
    videos = information.video_tracks
    if not videos:
        return None
    first, file = videos[0], information.general_tracks[0]
    known = file.format in _STATE_EACH_DURATION or file.istruncated == "Yes"
    duration = _number(first.duration) if known else None
    return MediaHeader(
        sizes=[(round(_number(each.height) or 0), round(_number(each.width) or 0)) for each in videos],
        seconds=duration and duration / 1000,
        quarter_turns=round((_number(first.rotate) or 0) / 90) % 4,
        interlaced=first.scan_type == "Interlaced",
        transfer=next((each for each in _HDR_TRANSFERS if first.transfer_characteristics == each), None),
        bare=file.format == first.format,
        rate=_number(first.frame_rate),
        sound=bool(information.audio_tracks),
    )


def _parse(path: Path, answer: queue.SimpleQueue[MediaInfo | None]) -> None:
    try:
        answer.put(MediaInfo.parse(str(path)))
    except (OSError, RuntimeError, ValueError, SyntaxError):  # of XML that is none, too
        answer.put(None)


def _number(value: Any) -> float | None:
    """A number that MediaInfo gives as one, or as text; None for 0, which stands for none."""
    try:
        return float(value) or None
    except (TypeError, ValueError):
        return None
