"""Pictures of a folder, a glob or a list of files as the frames of a sequence."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import threading
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path

from logvggt_jax.data.errors import BrokenPicture
from logvggt_jax.data.formats.ordering import natural_order, time_stamps
from logvggt_jax.errors import InputError, MissingInput, MissingPackage, disk_errors, too_little_memory
from logvggt_jax.frames import evenly_spaced
from logvggt_jax.reconstruction.sources.headers import PictureHeader, read_header
from logvggt_jax.reconstruction.sources.listing import is_glob, list_pictures, some, stem
from logvggt_jax.reconstruction.sources.masks import Masked, Masks
from logvggt_jax.reconstruction.sources.pictures import read_picture, refuse_depth
from logvggt_jax.reconstruction.sources.source import SkippedFrame, Source, SourceFrame, SourceOptions, fingerprint

_LONGEST_NAME = 240  # bytes; a file of the result adds its suffix, and file systems allow 255
_LOOKED_AT = 4  # pictures with 16 bits, whether they are depth
_ONE_LENS = 1.05  # ratio of focal lengths that rounding may give one lens


@dataclasses.dataclass(frozen=True)
class _Picture:
    """A frame before it is read."""

    name: str
    timestamp: float
    file: Path
    header: PictureHeader


class FolderSource(Source):
    """Pictures of a folder, a glob or a list of files, turned upright by their EXIF orientation.

    Folders and globs are taken in natural order (`img2` before `img10`, see `natural_order`), lists as they are. The
    time stamp of a frame is its name, where all names are moments that increase (see `time_stamps`), else its
    position. All headers are read here, the pixels of a picture when its loader is called.

    Pictures of another size than the others are an error, are left out (`skip`: the most frequent size stays), or
    all are cut to the smallest height and the smallest width from their centre (`crop`; nothing is scaled).

    Args:
      path: the folder, a glob (`photos/*.jpg`), or a text file with the path of an image a line.
      options: which images are taken; `start` and `end` count from the first, and as `fps` need names that are times.
      masks: one for each image, or one for all; None for none.

    Raises:
      MissingInput: no image, or one that has gone; an image without a mask, where there are masks.
      MissingPackage: all images are HEIC, or one is and `strict` is set, and pillow-heif is not installed.
      InputError: names or pictures that cannot be used; two sizes; too many broken pictures, or one with `strict`.
        While frames are loaded: too many broken ones, or too little memory for one.
    """

    def __init__(self, path: Path, options: SourceOptions, masks: Masks | None = None) -> None:
        listing = list_pictures(path, options.pattern)
        super().__init__(listing.root if is_glob(path) and not path.exists() else path, options, masks)
        self.address = path
        self.notes += listing.left_out + listing.doubts
        self._doubts = listing.doubts
        self._lock = threading.Lock()
        files = listing.files
        if not listing.in_order:
            relative = [str(file.relative_to(listing.root).with_name(stem(file.name))) for file in files]
            files = [files[position] for position in natural_order(relative)]
        times = time_stamps([stem(file.name) for file in files])
        chosen = self._chosen(times, len(files))
        names = _names([files[position] for position in chosen], listing.root)
        stamps = [float(position) for position in range(len(files))] if times is None else times
        self.is_timed = times is not None
        self._places = {name: place for place, name in enumerate(names)}
        pictures = self._with_headers(
            [(name, stamps[position], files[position]) for name, position in zip(names, chosen, strict=True)]
        )
        if times is None and not listing.in_order:
            self.notes += _against_clock(pictures)
        self._pictures, self._size = self._of_one_size(pictures)
        self.is_cut = any(picture.header.size != self._size for picture in self._pictures)
        noted = [focal for picture in self._pictures if (focal := picture.header.focal_length)]
        if noted and max(noted) > _ONE_LENS * min(noted):
            self.notes.append(
                f"images of several focal lengths by EXIF, {min(noted):.0f} to {max(noted):.0f} pixels: no intrinsics "
                "are those of all"
            )
        if masks is not None:
            if masks.path.resolve() in {picture.file.resolve().parent for picture in self._pictures}:
                raise InputError(f"{masks.path} holds the images themselves: give their masks in a folder of their own")
            self.notes.append(masks.check([_masked(picture) for picture in self._pictures]))

    def __len__(self) -> int:
        return len(self._pictures)

    @property
    def expected_frames(self) -> int:
        """Number of frames, without those that are known to be broken."""
        return len(self)

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) of the upright images, after cropping."""
        return self._size

    def files(self) -> Iterator[Path]:
        yield from super().files()
        yield from (picture.file for picture in self._pictures)

    def fingerprint(self, count: int) -> str:
        """See `Source.fingerprint`. What files further on may change, as sizes and time stamps, is part of it."""
        pictures = self._pictures[:count]
        with disk_errors(self.path):
            of_files = fingerprint(self.options, [picture.file for picture in pictures])
        text = json.dumps([of_files, self._size, [(picture.name, picture.timestamp) for picture in pictures]])
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def loaders(self, first: int = 0) -> Iterator[Callable[[], SourceFrame | None]]:
        """See `Source.loaders`; pictures before the first are not read."""
        return (partial(self._load, picture) for picture in self._pictures[first:])

    def _load(self, picture: _Picture) -> SourceFrame | None:
        header = picture.header
        try:
            image = read_picture(picture.file, orientation=header.orientation)
            if image.shape[:2] != header.size:
                raise BrokenPicture(
                    f"{picture.file} was {_pixels(header.size)} when the folder was opened and is now "
                    f"{_pixels(image.shape[:2])}: is it being written?"
                )
        except BrokenPicture as error:
            with self._lock:
                self._leave_out(picture.name, error)
                self._check_share()
            return None
        except MissingInput as error:
            raise MissingInput(f"{picture.file} was there when the source was opened and has gone since") from error
        except MemoryError as error:
            raise too_little_memory(picture.file, header.size, error) from error
        (height, width), (above, left) = self._size, _margins(header.size, self._size)
        part = slice(above, above + height), slice(left, left + width)
        mask = None if self.masks is None else self.masks.read(_masked(picture))[part]
        return SourceFrame(picture.name, picture.timestamp, image[part], header.focal_length, mask)

    def _leave_out(self, name: str, error: InputError) -> None:
        """Lists a broken picture in its place, once however often it is loaded."""
        if self.options.strict:
            raise error
        if all(skipped.name != name for skipped in self.skipped):
            self.skipped.append(SkippedFrame(name, str(error)))
            # Whichever thread was first. A run that is taken up may remember one that has gone since.
            self.skipped.sort(key=lambda skipped: self._places.get(skipped.name, len(self._places)))

    def _check_share(self) -> None:
        if self.options.too_many_broken(len(self.skipped), len(self._places)):
            raise InputError(
                f"{len(self.skipped)} of {len(self._places)} images of {self.path} cannot be read, more than the "
                f"{self.options.most_broken:.0%} that may be left out: {_reasons(self.skipped)}"
            )

    def _chosen(self, times: list[float] | None, count: int) -> list[int]:
        """Positions of the frames that the options take."""
        options = self.options
        chosen = list(range(count))
        if times is None:
            for name in ("fps", "start", "end"):
                if getattr(options, name) is not None:
                    raise InputError(
                        f"{name} needs time stamps, which names of images in {self.path} are not: use stride"
                    )
        else:
            begin, end = options.start or 0.0, float("inf") if options.end is None else options.end
            chosen = [position for position in chosen if begin <= times[position] - times[0] < end]
            if options.fps is not None:
                # Digits of a name are rounded; a frame that is due a hair later is due.
                due = [int((times[position] - times[0]) * options.fps + 1e-3) for position in chosen]
                chosen = chosen[:1] + [chosen[i] for i in range(1, len(chosen)) if due[i] > due[i - 1]]
            if not chosen:
                raise InputError(
                    f"no image of {self.path} lies between start and end ({begin:g} s to {end:g} s after the first; "
                    f"the last is at {times[-1] - times[0]:g} s)"
                )
        return chosen[:: options.stride][: options.max_frames]

    def _with_headers(self, frames: list[tuple[str, float, Path]]) -> list[_Picture]:
        """The pictures whose headers can be read; notes on the others."""
        pictures, no_decoder = list[_Picture](), list[tuple[Path, MissingPackage]]()
        for name, timestamp, file in frames:
            try:
                pictures.append(_Picture(name, timestamp, file, read_header(file)))
            except BrokenPicture as error:
                self._leave_out(name, error)
            except MissingPackage as error:
                if self.options.strict:
                    raise
                no_decoder.append((file, error))
        deep = [picture for picture in pictures if picture.header.deep_grey]
        for picture in [deep[place] for place in evenly_spaced(len(deep), _LOOKED_AT)] if deep else []:
            # Not the first alone: sensors begin with a blank one.
            try:
                refuse_depth(picture.file)
            except BrokenPicture as error:
                self._leave_out(picture.name, error)
                pictures.remove(picture)
        for suffix, count in Counter(file.suffix for file, _ in no_decoder).items():
            inside = "" if suffix.lower().startswith(".h") else " that are HEIC inside"
            self.notes.append(f"{count} {suffix}{inside} ignored: install logvggt-jax[heic], or convert to JPEG")
        self._check_share()
        if self.skipped:
            self.notes.append(f"left out: {len(self.skipped)} broken ({_reasons(self.skipped)})")
        if several := [picture for picture in pictures if picture.header.pages > 1]:
            listed = some(f"{picture.file.name}: {picture.header.pages}" for picture in several)
            self.notes.append(f"files that hold several pictures, of which one is read: {len(several)} ({listed})")
        if around := [picture.file.name for picture in pictures if picture.header.panorama]:
            self.notes.append(
                f"images that look all around (equirectangular), where a pinhole camera is assumed: {len(around)} "
                f"({some(around)}); cut views out of them beforehand"
            )
        if not pictures:
            if no_decoder:
                raise no_decoder[0][1]
            raise InputError(f"no image of {self.path} can be read: {_reasons(self.skipped)}")
        return pictures

    def _of_one_size(self, pictures: list[_Picture]) -> tuple[list[_Picture], tuple[int, int]]:
        """The pictures that are taken and the (H, W) that they are handed out in."""
        counts = Counter(picture.header.size for picture in pictures)
        (common, most), *others = counts.most_common()
        if not others:
            return pictures, common
        smallest = (min(height for height, _ in counts), min(width for _, width in counts))
        if self.options.size_mismatch == "skip":
            left = [picture for picture in pictures if picture.header.size != common]
            self.notes.append(
                f"left out: {len(left)} of another size than {_pixels(common)} ({some(p.file.name for p in left)})"
            )
            return [picture for picture in pictures if picture.header.size == common], common
        if self.options.size_mismatch == "crop":
            self.notes.append(f"images of {len(counts)} sizes are cut to {_pixels(smallest)} from their centre")
            return pictures, smallest
        example = {picture.header.size: picture.file.name for picture in reversed(pictures)}
        listed = "; ".join(f"{n} of {_pixels(size)} ({example[size]})" for size, n in counts.most_common(5))
        listed += "; …" if len(counts) > 5 else ""
        sideways = ", some upright and some sideways" if any((w, h) in counts for h, w in counts if h != w) else ""
        raise InputError(
            f"{self.path} holds images of {len(counts)} sizes{sideways}: {listed}. All "
            f"frames of a sequence need one size: --size-mismatch skip keeps the {most} of {_pixels(common)}, "
            f"--size-mismatch crop cuts all to {_pixels(smallest)} from their centre"
            + "".join(f"; {doubt}" for doubt in self._doubts)
        )


def _masked(picture: _Picture) -> Masked:
    return Masked(picture.name, picture.file.name, picture.header.size, picture.header.orientation)


def _names(files: list[Path], root: Path) -> list[str]:
    """What the frames are called, and so the files of a result; unique and short enough for that."""
    for choice in (
        lambda file: stem(file.name),
        # 1.jpg beside 1.png, or left/1.jpg beside right/1.jpg.
        lambda file: file.name,
        lambda file: "_".join(file.relative_to(root).parts),
    ):
        names = [choice(file) for file in files]
        if len(set(names)) == len(names):
            break
    else:
        twice = next(before for before, after in pairwise(sorted(names)) if before == after)
        raise InputError(f"two images would be called {twice!r}, as results are named after them: rename one")
    for name, file in zip(names, files, strict=True):
        length = len(name.encode(errors="surrogateescape"))
        if length > _LONGEST_NAME:
            raise InputError(
                f"{file}: its name is {length} bytes long; results are named after images: at most {_LONGEST_NAME}"
            )
        if any(unicodedata.category(character) in ("Cc", "Cs") for character in name):
            raise InputError(
                f"{str(file)!r}: its name has control characters, or is not UTF-8, and results are named after images: "
                "rename it"
            )
    return names


def _against_clock(pictures: list[_Picture]) -> list[str]:
    """A line where names put pictures in another order than the camera's clock: counters begin anew after 9999."""
    dated = [picture for picture in pictures if picture.header.taken is not None]
    back = [(one, two) for one, two in pairwise(dated) if (two.header.taken or "") < (one.header.taken or "")]
    if not back:
        return []
    one, two = back[0]
    return [
        f"by the camera's clock {two.file.name} was taken before {one.file.name} ({two.header.taken}, "
        f"{one.header.taken}), but follows it by name, {len(back)} times so: if that is wrong, give a list, as "
        "exiftool -if '$DateTimeOriginal' -FileOrder DateTimeOriginal -p '$Directory/$FileName' FOLDER > list.txt "
        "writes it"
    ]


def _margins(size: tuple[int, int], wanted: tuple[int, int]) -> tuple[int, int]:
    return (size[0] - wanted[0]) // 2, (size[1] - wanted[1]) // 2


def _reasons(skipped: list[SkippedFrame]) -> str:
    return "; ".join(each.reason for each in skipped[:3]) + ("; …" if len(skipped) > 3 else "")


def _pixels(size: tuple[int, ...]) -> str:
    return f"{size[1]} x {size[0]}"
