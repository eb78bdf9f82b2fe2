"""What the user should know of a video before it is used, one line each."""


def several_videos(name: str, sizes: list[tuple[int, int]], names: list[str], read: str) -> str:
    """Of videos of these sizes (H, W), which FFmpeg calls by these names, the one that is read."""
    listed = ", ".join(f"{w} x {h} (0:{each})" for (h, w), each in zip(sizes, names, strict=True))
    other = next(each for each in names if each != read)
    return (
        f"{name} holds {len(sizes)} videos, {listed}, of which 0:{read} is read; for another, "
        f"ffmpeg -i INPUT -map 0:{other} -c copy OUTPUT.mkv"
    )


def no_times(name: str, rate: float) -> str:
    """A bare stream of a codec."""
    return (
        f"{name} states no times: {rate:.4g} frames a second are assumed; if that is wrong, make a video "
        "that states them with ffmpeg -r RATE -i INPUT OUTPUT.mp4"
    )


def all_around(name: str, projection: str) -> str:
    """A panorama or a dome."""
    return (
        f"{name} looks all around ({projection}), where a pinhole camera is assumed: cut views out of it "
        "beforehand, with ffmpeg -i INPUT -vf v360=e:flat:h_fov=90:v_fov=60 OUTPUT.mp4 from equirectangular"
    )


def high_dynamic_range(name: str, transfer: str, treatment: str) -> str:
    """Coded by PQ or HLG; `treatment` says what becomes of the frames."""
    return f"{name} is HDR ({transfer}): its frames are {treatment}; tone-map it beforehand if the result suffers"


def oblong_pixels(name: str, width: int, height: int) -> str:
    """Pixels of this width to height."""
    return (
        f"{name}: its pixels are not square ({width}:{height}) and are used as they "
        "are stored; stretch it beforehand with ffmpeg -i INPUT -vf scale=iw*sar:ih,setsar=1 OUTPUT"
    )


def begins_late(name: str, frames: int) -> str:
    """So many frames refer to one that is not in the file."""
    return f"{name} begins in the middle: {frames} frames before its first key frame are left out"


def looks_interlaced(name: str) -> str:
    """Pictures that show two moments, of which nothing in the file says so."""
    return (
        f"{name} looks interlaced, though nothing in it says so: its pictures show two moments in alternate lines; "
        "deinterlace it beforehand with ffmpeg -i INPUT -vf bwdif=send_frame OUTPUT.mp4"
    )
