"""Whole pictures of interlaced videos."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import av
import av.error
import av.filter

from logvggt_jax.errors import InputError

# FFmpeg's field orders, by the field that is shown first.
_TOP_FIELD_FIRST, _BOTTOM_FIELD_FIRST = (2, 5), (3, 4)


class Deinterlacer:
    """Makes whole pictures of those that show two moments in alternate lines; others pass unchanged.

    Frames come out in order, as many as go in, one later than they went in once an interlaced one has been met.

    Args:
      stream: the stream, whose header may say that it is interlaced.
      name: what messages call it.
    """

    def __init__(self, stream: av.video.stream.VideoStream, name: str) -> None:
        self._stream, self._name = stream, name
        self._graph: av.filter.Graph | None = None
        self._made_for: tuple[object, ...] = ()
        self._inside: deque[av.VideoFrame] = deque()

    def push(self, frame: av.VideoFrame) -> Iterator[tuple[av.VideoFrame, av.VideoFrame]]:
        """Takes a frame; gives frames that are ready, each as it was decoded and as it is to be shown."""
        if self._graph is None and not is_interlaced(frame, self._stream):
            yield frame, frame
            return
        made_for = (frame.width, frame.height, frame.format.name, frame.colorspace, frame.color_range)
        if self._graph is None or made_for != self._made_for:
            yield from self.drain()
            try:
                self._graph, self._made_for = self._build(frame), made_for
            except av.FFmpegError as error:
                raise InputError(
                    f"{self._name} is interlaced, and its pixel format {frame.format.name} cannot be deinterlaced "
                    f"({error.strerror}): do it beforehand with ffmpeg -i INPUT -vf bwdif=send_frame OUTPUT.mp4"
                ) from error
        self._inside.append(frame)
        self._graph.push(frame)
        yield from self._ready()

    def drain(self) -> Iterator[tuple[av.VideoFrame, av.VideoFrame]]:
        """Gives all frames that are inside."""
        if self._graph is not None:
            self._graph.push(None)
            yield from self._ready()
            self._graph = None
            self._inside.clear()

    def _ready(self) -> Iterator[tuple[av.VideoFrame, av.VideoFrame]]:
        while self._inside and self._graph is not None:
            try:
                whole = self._graph.pull()
            except (av.error.BlockingIOError, av.error.EOFError):
                return
            yield self._inside.popleft(), whole

    def _build(self, frame: av.VideoFrame) -> av.filter.Graph:
        order = self._stream.codec_context.field_order
        # A file whose decoder does not mark frames may still say of all of them that they are interlaced.
        everything = not frame.interlaced_frame and is_interlaced(frame, self._stream)
        graph = av.filter.Graph()
        source = graph.add(
            "buffer",
            video_size=f"{frame.width}x{frame.height}",
            pix_fmt=frame.format.name,
            time_base=str(self._stream.time_base),
            pixel_aspect="1/1",
            colorspace=str(int(frame.colorspace)),
            range=str(int(frame.color_range)),
        )
        parity = "auto" if not everything else "tff" if order in _TOP_FIELD_FIRST else "bff"
        bwdif = graph.add("bwdif", mode="send_frame", parity=parity, deint="all" if everything else "interlaced")
        graph.link_nodes(source, bwdif, graph.add("buffersink")).configure()
        return graph


def is_interlaced(frame: av.VideoFrame, stream: av.video.stream.VideoStream) -> bool:
    """Whether the frame shows two moments in alternate lines, as it says itself or the header says of all."""
    return frame.interlaced_frame or stream.codec_context.field_order in (*_TOP_FIELD_FIRST, *_BOTTOM_FIELD_FIRST)
