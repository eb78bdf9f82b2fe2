"""What FFmpeg within OpenCV says of damage, which it hands out in no other way, and OpenCV's own warnings."""

import atexit
import contextlib
import ctypes
import functools
import os
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2

# FFmpeg's numbers: the less, the more serious. What is less serious than the second is about its inner life.
_ERROR, _INFO = 16, 32
# What is said without being called an error of a packet that is not whole, and of parts that a decoder guesses.
_CORRUPT, _GUESSED = "Packet corrupt", "concealing "
# The decoder of JPEG, and how begins what it says of coefficients that are missing or wrong, or whose header is.
_JPEG = "mjpeg"
_HALF_JPEG = re.compile(r"overread|error (?:count|dc|y=)|mjpeg_decode_dc|decode_sos|Can not process SOS")
_LONGEST = 1024
# What a line begins with: who speaks, behind those on whose behalf.
_SPEAKERS = re.compile(r"(?:\[(\S+) @ \w+\]\s*)+")
# Where Linux lists the files of which this process has code.
_LOADED = Path("/proc/self/maps")


class Message(NamedTuple):
    """A line that FFmpeg says.

    Attributes:
      level: how serious it is by FFmpeg's numbers, of which a smaller one is more so.
      text: without the name of the part that says it.
      speaker: that part, such as a codec; empty for none.
    """

    level: int
    text: str
    speaker: str


class _Ears(threading.local):
    """Where the messages of each thread go; None for the terminal."""

    found: list[Message] | None = None


_ears = _Ears()


class _Silence:
    """OpenCV's level of logging is the whole process's: the first thread lowers it, the last one restores it."""

    def __init__(self) -> None:
        self._lock, self._inside, self._before = threading.Lock(), 0, 0

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                cv2.utils.logging.setLogLevel(self._before)


_silence = _Silence()


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Without what OpenCV prints: whoever calls it says the same."""
    with _silence:
        yield


@contextlib.contextmanager
def captured_messages() -> Iterator[list[Message]]:
    """What FFmpeg says in the block to this thread, line by line as it comes, instead of printing it; OpenCV is quiet.

    Nothing is heard where `hears_all` says so. A decoder has to work in the thread that calls it.
    """
    found: list[Message] = []
    before, _ears.found = _ears.found, found
    library = _library()
    if library is not None:
        # Each time: OpenCV may set its own when it opens the first video.
        library.av_log_set_callback(_listener(library))
    try:
        with _silence:
            yield found
    finally:
        _ears.found = before


def errors_of_ffmpeg(messages: list[Message]) -> list[str]:
    """Of what was said in `captured_messages` that which tells of damage, but for what is said of frames whose damaged
    parts are guessed: these are counted."""
    guessing = {each.speaker for each in messages if each.text.startswith(_GUESSED)}
    return [each.text for each in messages if each.level <= _ERROR and each.speaker not in guessing]


def tells_half_jpeg(messages: list[Message]) -> bool:
    """Whether FFmpeg said in `captured_messages` that it could not decode all of a JPEG, which is then half grey,
    or the picture before it."""
    return any(each.speaker == _JPEG and _HALF_JPEG.match(each.text) for each in messages)


def guessed_frames(messages: list[Message]) -> int:
    """Of how many frames FFmpeg said in `captured_messages` that damaged parts are filled by guesses: once of each."""
    return sum(each.text.startswith(_GUESSED) for each in messages)


def tells_corrupt_packet(messages: list[Message]) -> bool:
    """Whether FFmpeg said in `captured_messages` that a packet is not whole, or that some before it are missing."""
    return any(each.text.startswith(_CORRUPT) for each in messages)


def hears_all() -> bool:
    """Whether FFmpeg's messages can be heard: its library is there for itself, not within OpenCV."""
    return _library() is not None


@functools.cache
def _library() -> ctypes.CDLL | None:
    """The part of OpenCV's FFmpeg through which all of it speaks; None where it cannot be found."""
    home = Path(cv2.__file__).parent
    for path in (*home.parent.glob("opencv*.libs/libavutil*"), *home.glob(".dylibs/libavutil*"), *_loaded_ones()):
        with contextlib.suppress(OSError):  # of another OpenCV, which is not loaded
            library = ctypes.CDLL(str(path), mode=os.RTLD_LAZY | os.RTLD_NOLOAD)
            # No message comes when there is no interpreter any more.
            atexit.register(library.av_log_set_callback, library.av_log_default_callback)
            return library
    return None


def _loaded_ones() -> list[Path]:
    """Those that an OpenCV which was built on its own shares with other programs; not PyAV's own."""
    lines = _LOADED.read_text().splitlines() if _LOADED.exists() else []
    paths = {Path(line.split(maxsplit=5)[-1]) for line in lines if "/libavutil" in line}
    return sorted(path for path in paths if path.parent.name != "av.libs")


@functools.cache
def _listener(library: ctypes.CDLL) -> Any:
    """What FFmpeg calls with a message: who speaks, how serious it is, a form and the values that fill it."""

    def listen(speaker: int | None, level: int, form: bytes, values: int | None) -> None:
        called = ctypes.c_void_p(speaker), level, form, ctypes.c_void_p(values)
        if _ears.found is None:
            library.av_log_default_callback(*called)
        elif level <= _INFO:
            line, named = ctypes.create_string_buffer(_LONGEST), ctypes.c_int(1)
            library.av_log_format_line(*called, line, _LONGEST, ctypes.byref(named))
            _ears.found.append(_message(level, line.value.decode(errors="replace").strip()))

    return ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p)(listen)


def _message(level: int, line: str) -> Message:
    begin = _SPEAKERS.match(line)
    return Message(level, line[begin.end() :] if begin else line, begin[1] if begin else "")
