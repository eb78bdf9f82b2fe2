"""What OpenCV and FFmpeg within it print: hidden where it says nothing new, read where it is said in no other way."""

import contextlib
import ctypes
import functools
import os
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2

_STDERR = threading.RLock()
# A line of FFmpeg begins with the part of it that speaks and where that lies in memory, then how serious it is.
_COLOUR = rb"(?:\x1b\[[\d;]*m)*"
_OF_FFMPEG = re.compile(
    _COLOUR
    + rb"(?:(?:\[[^\]\n]+ @ (?:0x)?[0-9a-fA-F]+\] )+|(?=\[[a-z]+\] ))"
    + _COLOUR
    + rb"(?:\[(info|warning|error|fatal|panic)\] )?"
    + _COLOUR
    + rb"([^\n\x1b]*)\n?"
    + _COLOUR
)
_MILD = (b"info", b"warning")
# What is said without being called an error of a packet that is not whole, and of parts that a decoder guesses.
_CORRUPT, _GUESSED = b"Packet corrupt", b"concealing "
# FFmpeg's numbers of a level, and of the wish that lines state theirs.
_INFO, _WITH_LEVEL = 32, 2
# A line of OpenCV, and one of FFmpeg that goes on from the one before.
_HIDDEN = re.compile(
    rb"\[ ?(?:FATAL|ERROR|WARN|INFO|DEBUG):\d+@[\d.]+\][^\n]*\n?|Consider increasing the value for the 'ana[^\n]*\n?"
)
# By either of these, which are read once, FFmpeg's errors are printed elsewhere.
_REDIRECTED = ("OPENCV_FFMPEG_LOGLEVEL", "OPENCV_FFMPEG_DEBUG")


def redirected() -> str | None:
    """The environment variable for which FFmpeg's errors cannot be read; None for none."""
    return next((name for name in _REDIRECTED if name in os.environ), None)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Without OpenCV's warnings: an error says the same."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


@contextlib.contextmanager
def captured_messages() -> Iterator[Callable[[], bytes]]:
    """What OpenCV and FFmpeg print to standard error in the block: they hand out errors in no other way.

    Gives a function that returns what has been printed so far. None of their lines reaches the terminal; what others
    print meanwhile does behind the block.
    """
    # The descriptor is the whole process's: two threads would restore it out of turn.
    with _STDERR:
        with contextlib.suppress(OSError):
            if sys.stderr is not None:
                sys.stderr.flush()
        try:
            kept = os.dup(2)
        except OSError:  # of a process that was started without
            kept = os.open(os.devnull, os.O_WRONLY)
        try:
            with tempfile.TemporaryFile(buffering=0) as file:

                def printed() -> bytes:
                    return os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0)

                os.dup2(file.fileno(), 2)
                try:
                    with _all_told():
                        yield printed
                finally:
                    os.dup2(kept, 2)
                    if others := _HIDDEN.sub(b"", _OF_FFMPEG.sub(b"", printed())):
                        with contextlib.suppress(OSError):  # nobody listens
                            os.write(kept, others)
        finally:
            os.close(kept)


def errors_of_ffmpeg(printed: bytes) -> list[str]:
    """What FFmpeg says of damage in `captured_messages`, one line each."""
    found = (line.groups() for line in _OF_FFMPEG.finditer(printed))
    return [
        text.decode(errors="replace").strip()
        for level, text in found
        if level not in _MILD or text.startswith(_GUESSED)
    ]


def tells_corrupt_packet(printed: bytes) -> bool:
    """Whether FFmpeg says in `captured_messages` that a packet is not whole, or that some before it are missing."""
    return any(line[2].startswith(_CORRUPT) for line in _OF_FFMPEG.finditer(printed))


def hears_all() -> bool:
    """Whether FFmpeg can be asked for all that it notices; else it tells what it calls an error alone."""
    return _library() is not None


@functools.cache
def _library() -> ctypes.CDLL | None:
    """The part of OpenCV's FFmpeg that knows how much is to be printed; None where OpenCV did not bring it along."""
    home = Path(cv2.__file__).parent
    for path in (*home.parent.glob("opencv*.libs/libavutil*"), *home.glob(".dylibs/libavutil*")):
        with contextlib.suppress(OSError):  # of another OpenCV, which is not loaded
            return ctypes.CDLL(str(path), mode=os.RTLD_LAZY | os.RTLD_NOLOAD)
    return None


@contextlib.contextmanager
def _all_told() -> Iterator[None]:
    library = _library()
    if library is None:
        yield
        return
    before = library.av_log_get_level(), library.av_log_get_flags()
    library.av_log_set_level(_INFO)
    library.av_log_set_flags(_WITH_LEVEL)
    try:
        yield
    finally:
        library.av_log_set_level(before[0])
        library.av_log_set_flags(before[1])
