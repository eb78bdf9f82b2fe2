"""What the header of a video says, read by PyAV."""

from __future__ import annotations

import re
from collections.abc import Iterator
from fractions import Fraction

import av
import av.format
import av.logging

from logvggt_jax.reconstruction.sources.deinterlacing import is_interlaced

# FFmpeg's numbers of what a lens or its stitching program projects onto.
_PROJECTIONS = {0: "equirectangular", 1: "a cube map", 2: "equirectangular", 3: "half equirectangular", 5: "fisheye"}
_HDR_TRANSFERS = {16: "PQ", 18: "HLG"}


def notes_on(
    name: str, container: av.container.InputContainer, stream: av.video.stream.VideoStream, frame: av.VideoFrame
) -> Iterator[str]:
    """What the user should know of a video, as far as it shows in the header and the first frame."""
    streams = moving_streams(container)
    if len(streams) > 1:
        sizes = ", ".join(f"{each.width} x {each.height} (0:{each.index})" for each in streams)
        other = next(each.index for each in streams if each.index != stream.index)
        yield (
            f"{name} holds {len(streams)} videos, {sizes}, of which 0:{stream.index} is read; for another, "
            f"ffmpeg -i INPUT -map 0:{other} -c copy OUTPUT.mkv"
        )
    if has_no_times(container):
        rate = float(average_rate(container, stream) or 1)
        yield (
            f"{name} states no times: {rate:.4g} frames a second are assumed; if that is wrong, make a video "
            "that states them with ffmpeg -r RATE -i INPUT OUTPUT.mp4"
        )
    if is_interlaced(frame, stream):
        yield f"{name} is interlaced: its frames are deinterlaced (bwdif), and finest lines lose some detail"
    spherical = frame.side_data.get("SPHERICAL")
    if spherical and (projection := _PROJECTIONS.get(int.from_bytes(bytes(spherical)[:4], "little"))):
        yield (
            f"{name} looks all around ({projection}), where a pinhole camera is assumed: cut views out of it "
            "beforehand, with ffmpeg -i INPUT -vf v360=e:flat:h_fov=90:v_fov=60 OUTPUT.mp4 from equirectangular"
        )
    if transfer := _HDR_TRANSFERS.get(frame.color_trc):
        yield (
            f"{name} is HDR ({transfer}): its frames are reduced to 8 bits without tone mapping, which makes "
            "them look pale; tone-map it beforehand if the result suffers"
        )
    ratio = stream.sample_aspect_ratio
    if ratio and ratio != 1:
        yield (
            f"{name}: its pixels are not square ({ratio.numerator}:{ratio.denominator}) and are used as they "
            "are stored; stretch it beforehand with ffmpeg -i INPUT -vf scale=iw*sar:ih,setsar=1 OUTPUT"
        )


def moving_streams(container: av.container.InputContainer) -> list[av.video.stream.VideoStream]:
    """The video streams but for cover pictures, which are streams too."""
    pictures = av.stream.Disposition.attached_pic | av.stream.Disposition.timed_thumbnails
    return [stream for stream in container.streams.video if not stream.disposition & pictures]


def has_no_times(container: av.container.InputContainer) -> bool:
    """Whether the format states none, as a bare H.264 stream."""
    return bool(container.format.flags & av.format.Flags.no_timestamps.value)


def average_rate(container: av.container.InputContainer, stream: av.video.stream.VideoStream) -> Fraction | None:
    """Frames a second on average."""
    if has_no_times(container):
        # What the codec states, if it does: the library guesses 24 for 12, and the average is a default.
        return stream.codec_context.framerate or stream.guessed_rate or stream.average_rate
    # Of some formats the library takes the unit of time for the distance of two frames.
    return min((rate for rate in (stream.average_rate, stream.guessed_rate) if rate), default=None)


def likely_frames(stated: int | None, seconds: float | None, rate: Fraction | None) -> int | None:
    """Number of frames that are shown; an edited file states those as well that it does not show, a file in fragments
    those of the first alone."""
    by_time = max(1, round(seconds * rate)) if seconds and rate else None
    if stated is None or by_time is None:
        return stated or by_time
    return stated if abs(by_time - stated) <= 0.01 * max(by_time, stated) + 2 else by_time


def duration(container: av.container.InputContainer, stream: av.video.stream.VideoStream) -> float | None:
    """Seconds from the first frame to the end of the last."""
    if stream.duration:
        return float(stream.duration * stream.time_base)
    start = float((stream.start_time or 0) * stream.time_base)
    if tag := re.fullmatch(r"(\d+):(\d+):(\d+\.?\d*)", stream.metadata.get("DURATION", "")):
        # Matroska's, counted from the beginning of the file.
        hours, minutes, seconds = map(float, tag.groups())
        return max(0.0, 3600 * hours + 60 * minutes + seconds - start) or None
    if not container.duration or len(container.streams) > 1:
        return None
    total = container.duration / av.time_base
    return total - start if "matroska" in container.format.name else total


def unknown_codec(container: av.container.InputContainer, index: int) -> str:
    """The codec of a stream for which there is no decoder, as FFmpeg names it."""
    level = av.logging.get_level()
    # The library tells it in its log only.
    av.logging.set_level(av.logging.INFO)
    try:
        log = container.dumps_format()
    finally:
        av.logging.set_level(level)
    found = re.search(rf"Stream #0:{index}\b[^\n]*Video: ([^,\n]+)", log)
    return found[1] if found else "(unknown)"
