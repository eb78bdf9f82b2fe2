"""What the packets of a video tell beside its pictures: which frames are missing, and where the size changes."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

from logvggt_jax.reconstruction.sources.decoding import Damage
from logvggt_jax.reconstruction.sources.missing_frames import MissingFrames
from logvggt_jax.reconstruction.sources.opencv_packets import STORE_DECODING_TIMES, Packet, PacketReader

_MICROSECOND = Fraction(1, 1_000_000)
# Packets that are read before a frame is looked at: none is stored so far from the place where it is shown.
_AHEAD = 48
# Frames that a decoder keeps when another codec follows.
_MOST_KEPT = 2
# Some formats mark no key frames: after so many packets the first begins the video.
_LONGEST_LEAD = 300
# Bytes by which a format is known.
_HEAD = 4
_ASF = STORE_DECODING_TIMES[1]
# What streams of MPEG-1, MPEG-2 and JPEG begin with that no container gives times; of others all time stamps are 0.
_BARE = (b"\0\0\1\xb3", b"\xff\xd8")


class TimeStamps(NamedTuple):
    """What time stamps of packets and frames say together.

    Attributes:
      exist: the file states some; a bare stream of a codec states none.
      as_stored: those of the packets only grow, and those of the frames do not. The k-th frame is then shown at the
        k-th time, though frames are shown in another order than stored.
      begin: seconds from the file's beginning to the first packet.
    """

    exist: bool
    as_stored: bool
    begin: float


def look_at_times(source: str, shown: list[int]) -> TimeStamps:
    """Compares the first packets with the time stamps of the first frames that come out of the decoder."""
    reader = PacketReader(source)
    packets = [packet for packet in itertools.islice(reader, _AHEAD) if packet is not None]
    reader.close()
    with Path(source).open("rb") as file:
        head = file.read(_HEAD)
    stamps = [packet.stamp for packet in packets]
    # The only frame of a file is shown at its beginning.
    exist = (any(stamps) or any(shown) or len(shown) < 2) and not head.startswith(_BARE)
    # Of the last frames of a short file OpenCV may know no time, for which 0 stands.
    known = [*shown[:1], *(each for each in shown[1:] if each)]
    late = known != sorted(known)
    if shown and (head.startswith(_ASF) or (head.startswith(STORE_DECODING_TIMES) and not reader.holds_one)):
        # Frames come with the times of the packets that follow theirs.
        late = late or 1000 * shown[0] > next((packet.stamp for packet in packets if packet.key), math.inf)
    return TimeStamps(exist, stamps == sorted(set(stamps)) and late, reader.begin)


class PacketFollower:
    """Reads the packets of a file along with the pictures that a decoder makes of them.

    Recordings that were joined, where time begins anew, are told apart.

    Attributes:
      size: (H, W) before rotation, as stated for the picture at hand; None where nothing states it.
      orientation: EXIF's, that the camera noted in the picture at hand, or in the first where none is; 1 for none.
      key: decoding could begin with the picture at hand.
      known: it is known which packet a picture is of.
      reordered: see `Codec`.
      follows_loss: see `Picture`, of that at hand.
      holds_picture: see `Packet`, of that at hand.
      lead: frames before the first key frame, which refer to some that are not there.
      lead_seconds: how long these would be shown.

    Args:
      source: the file's absolute path.
      rate: frames a second on average; 0 where it is not known.
      timed: there are time stamps.
      edited: packets are stored that are not to be shown, and times count from the first that is.
    """

    def __init__(self, source: str, rate: float, *, timed: bool, edited: bool) -> None:
        self._reader = PacketReader(source)
        self._packets = iter(self._reader)
        self._missing = MissingFrames(_MICROSECOND)
        self._step = round(1e6 / rate) if math.isfinite(rate) and rate > 0 else None
        self._timed, self._edited = timed, edited
        self.known, self.reordered = self._reader.frame_each, self._reader.reordered
        # Whether all time stamps of frames so far were those of packets. Without times packets are numbered.
        self._trusted = (timed or not self.reordered) and not edited
        # Time stamps of key frames, of frames before which some are missing, and of those that hold no picture.
        self._keys: set[int] = set()
        self._after_loss: set[int] = set()
        self._empty: set[int] = set()
        # Those of frames that were said to be missing.
        self._given_up: set[int] = set()
        # What is stated of pictures from one on, of which the first says when it is stored and shown.
        self._stated: deque[tuple[int, int, tuple[int, int] | None, int]] = deque()
        self._stored = self._shown = self._unreadable = 0
        self._is_first_part = True
        self._joint: Packet | None = None
        self.size: tuple[int, int] | None = None
        self.orientation = 1
        self.key = self.follows_loss = False
        self.holds_picture = True
        self.lead, self.lead_seconds = 0, 0.0
        self._lead_begins = math.inf
        self._begin()
        self._fill(_AHEAD)
        if self._stated:
            self.orientation = self._stated[0][3]

    def precedes_key_frame(self, stamp: int, refers: bool) -> bool:
        """Whether a frame that is shown at this time, and may refer to others, comes before the first key frame."""
        if self._shown or self._edited or not self.lead:
            return False
        return refers if not self.known else self._key is not None and stamp < self._key

    def begins_part(self) -> bool:
        """Whether the next frame can be the first of a part, whose time begins anew."""
        return self._joint is not None and not self._missing.anything_waits()

    def codec_change(self, failures: int) -> tuple[str, str] | None:
        """The codec so far and the one that follows, where nothing else is left than what so many failures, and frames
        that the decoder never gives, stand for."""
        left = self._stored - self._shown - failures
        return self._reader.change if left <= _MOST_KEPT else None

    def is_over(self, failures: int) -> bool:
        """Whether nothing is left but what so many failures stand for."""
        self._fill(failures + 1)
        return self._stored - self._shown <= failures

    def fail(self, reason: str) -> None:
        """A frame could not be decoded."""
        self._missing.fail(reason)

    def before(self, stamp: int) -> Iterator[Damage]:
        """What is missing before the frame that is shown at this time; it is then the picture at hand."""
        if self._joint is not None and stamp < self._last:
            yield from self._part_ends()
        self._fill(_AHEAD)
        # What was said to be missing may yet come.
        self._trusted = self._trusted and (self._missing.waits_for(stamp) or stamp in self._given_up)
        yield from self._count(self._missing_before(stamp))
        self._show(stamp)

    def failures(self) -> Iterator[Damage]:
        """What failed before the next frame, where the frames' own time stamps tell nothing."""
        self._fill(_AHEAD)
        yield from self._count(self._missing.failures())

    def next_in_order(self) -> float | None:
        """Seconds at which the next frame is shown, by the order of storage; it is then the picture at hand."""
        stamp = self._missing.take_next()
        self._show(self._last if stamp is None else stamp)
        return None if stamp is None or not self._timed else float(stamp * _MICROSECOND)

    def rest(self) -> Iterator[Damage]:
        """What is missing up to the end of the file."""
        self._fill(None)
        while self._joint is not None:
            yield from self._part_ends()
            self._fill(None)
        yield from self._all_missing()

    def close(self) -> None:
        """Closes the file."""
        self._reader.close()

    def _begin(self) -> None:
        """A part whose time stamps have nothing to do with those before."""
        self._key: int | None = None
        self._last = self._highest = -1
        self._given_up.clear()
        self._in_part = 0

    def _part_ends(self) -> Iterator[Damage]:
        yield from self._all_missing()
        while self._stated:
            *_, self.size, self.orientation = self._stated.popleft()
        first, self._joint = self._joint, None
        self._is_first_part = False
        self._begin()
        if first is not None:
            self._take(first)

    def _all_missing(self) -> Iterator[Damage]:
        if self._since() is not None:
            self._missing.fail_all("gives no picture")
        yield from self._count(self._missing.failures())
        while self._missing.take_next() is not None:
            pass

    def _missing_before(self, stamp: int) -> Iterator[Damage]:
        for damage in self._missing.before(stamp, self._since()):
            at = _microseconds(damage)
            yield from self._in_gap(at)
            self._given_up.add(at)
            yield damage
        yield from self._in_gap(stamp)

    def _in_gap(self, stamp: int) -> Iterator[Damage]:
        """Failures that no packet explains, as it could not be read either: they are known by the gaps they leave."""
        while self._step is not None and self._last >= 0 and 2 * (stamp - self._last) > 3 * self._step:
            failure = self._missing.take_failure()
            if failure is None and not self._unreadable:
                return
            self._unreadable = max(0, self._unreadable - 1)
            yield Damage(float((self._last + self._step) * _MICROSECOND), failure or "cannot be read")

    def _since(self) -> int | None:
        return self._key if self._trusted and self._reader.frame_each else None

    def _count(self, damages: Iterator[Damage]) -> Iterator[Damage]:
        for damage in damages:
            self._shown += 1
            if damage.seconds is not None:
                self._last = max(self._last, _microseconds(damage))
            yield damage if self._timed else damage._replace(seconds=None)

    def _show(self, stamp: int) -> None:
        self._last = max(self._last, stamp)
        self.key, self.follows_loss = stamp in self._keys, stamp in self._after_loss
        self._keys.discard(stamp)
        self.holds_picture = stamp not in self._empty
        self._after_loss.discard(stamp)
        self._empty.discard(stamp)
        by_time = self._since() is not None or (self._timed and self._reader.holds_one)
        while self._stated and (self._stated[0][1] <= stamp if by_time else self._stated[0][0] <= self._shown):
            *_, self.size, self.orientation = self._stated.popleft()
        self._shown += 1

    def _fill(self, ahead: int | None) -> None:
        """Reads packets until so many more are in than frames were shown, all for None, but none beyond a joint."""
        while self._joint is None and (ahead is None or self._stored < self._shown + ahead):
            try:
                packet = next(self._packets)
            except StopIteration:
                return
            if packet is not None and not self._timed:
                packet = packet._replace(stamp=self.lead + self._stored)
            if packet is None:
                self._unreadable += 1
            elif self._is_joint(packet):
                self._joint = packet
            else:
                self._take(packet)

    def _is_joint(self, packet: Packet) -> bool:
        """Whether time begins anew: at a key frame, or earlier than where the part began."""
        earlier = self._key is not None and self._in_part > _AHEAD and packet.stamp < self._key
        return packet.stamp < self._highest and (packet.key or earlier)

    def _take(self, packet: Packet) -> None:
        self._highest = max(self._highest, packet.stamp)
        self._in_part += 1
        # What a later part begins with is decoded by what is known from the one before.
        if self._key is None and (packet.key or not self._is_first_part or self.lead == _LONGEST_LEAD):
            self._key = packet.stamp
            if self._is_first_part:
                self.lead_seconds = max(0.0, packet.stamp - self._lead_begins) * float(_MICROSECOND)
        if self._key is None:
            self.lead += 1
            self._lead_begins = min(self._lead_begins, packet.stamp)
            return
        if not self._stated or self._stated[-1][2:] != (packet.size, packet.orientation):
            self._stated.append((self._stored, packet.stamp, packet.size, packet.orientation))
        if packet.key:
            self._keys.add(packet.stamp)
        if packet.follows_loss:
            self._after_loss.add(packet.stamp)
        if not packet.holds_picture:
            self._empty.add(packet.stamp)
        if packet.holds_frame:
            self._missing.expect(packet.stamp)
            self._stored += 1


def _microseconds(damage: Damage) -> int:
    return round(1e6 * (damage.seconds or 0.0))
