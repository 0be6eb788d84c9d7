"""Pictures of a film's file with their times, one after the other, and nothing but that file.

PyAV (the extra ``video``) reads it through a stream of ours, with the demuxer that its first bytes
call for: playlists, lists of other files and addresses are no films here, and what a file names
beside itself is not opened.
"""

from __future__ import annotations

from codecs import getincrementaldecoder
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from solver.errors import InputError
from solver.kinds.inputs import FILMS

QUARTERS = 4  # turns that make a whole one
# first boxes of MP4 and MOV, by their names
BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")
MATROSKA = b"\x1a\x45\xdf\xa3"  # and WebM
LISTS = (b"#EXTM3U", b"ffconcat")  # of other files


@dataclass(frozen=True)
class FilmLimits:
    """Limits of the films that are read."""

    least_side: int = 64  # px
    most_pixels: int = 36 << 20  # what cameras film
    most_frames: int = 20_000
    threads: int = 2  # of the decoder: each may keep some frames
    # a file whose pictures end so much sooner than it claims, s and of its length, is cut off
    missing: tuple[float, float] = (0.5, 0.05)


FILM_LIMITS = FilmLimits()


@dataclass(frozen=True)
class FilmPicture:
    """A frame: its ``time`` in s, as the file has it."""

    time: float
    decoded: Any

    def pixels(self) -> NDArray[np.uint8]:
        """Return it upright (h, w, 3), in sRGB."""
        quarters = int(round(self.decoded.rotation / 90) % QUARTERS)
        return np.ascontiguousarray(np.rot90(self.decoded.to_ndarray(format="rgb24"), quarters))


def is_film(path: Path) -> bool:
    """Tell by a file's first bytes whether it is to be read as a film: as one, or as none at all.

    Playlists are, and what is called a film and is no text.
    """
    head = _head(path)
    is_named = path.suffix.lower() in FILMS and not _is_text(head)
    return is_named or _demuxer(head) is not None or head.startswith(LISTS)


def decode_film(
    path: Path, code: str = "film", limits: FilmLimits = FILM_LIMITS
) -> Iterator[FilmPicture]:
    """Yield the pictures of a file, in the order of their times.

    Raises :class:`InputError`, with ``code`` before the dot: ``film.extra`` without PyAV,
    ``film.unreadable`` for what is no film, has no pictures, is damaged or cut off, ``film.size``
    for frames that are too small or too large, ``film.long`` for too many.
    """
    if find_spec("av") is None:
        message = "reading a film needs PyAV, which is not installed: pip install "
        raise InputError(f"{code}.extra", f"{message}'myoface[video]'")
    import av

    demuxer = _demuxer(_head(path))
    if demuxer is None:
        raise _unreadable(path, code, "it is no MP4, MOV, WebM, Matroska or AVI")
    try:
        with (
            path.open("rb") as stream,
            av.open(
                stream, format=demuxer, io_open=_open_nothing, metadata_errors="ignore"
            ) as film,
        ):
            yield from _Decoded(path, code, limits).frames(film)
    except (av.FFmpegError, OSError, ValueError, MemoryError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise _unreadable(path, code, str(error) or "it is damaged") from error


@dataclass(frozen=True)
class _Decoded:
    path: Path
    code: str
    limits: FilmLimits

    def frames(self, film: Any) -> Iterator[FilmPicture]:
        """Yield the pictures of an opened file."""
        if not film.streams.video:
            raise _unreadable(self.path, self.code, "it has no pictures")
        stream = film.streams.video[0]
        if stream.codec_context is None:
            raise _unreadable(self.path, self.code, "nothing here decodes its pictures")
        self._check_size(stream.width, stream.height)
        length = float((stream.duration or 0) * (stream.time_base or 0))
        rate = float(stream.average_rate or 0) or 30.0
        if length * rate > 2 * self.limits.most_frames:
            self._refuse_length()
        stream.codec_context.options = {"max_pixels": str(self.limits.most_pixels)}
        stream.codec_context.thread_count = self.limits.threads
        count = 0
        last = -np.inf
        begun = 0.0
        for frame in film.decode(stream):
            time = count / rate if frame.time is None else float(frame.time)
            if time <= last:
                continue  # twice at one time: the first is seen
            self._check_size(frame.width, frame.height)
            begun = begun if count else time
            count = count + 1
            last = time
            if count > self.limits.most_frames:
                self._refuse_length()
            yield FilmPicture(time, frame)
        if not count:
            raise _unreadable(self.path, self.code, "it has no frames")
        seconds, part = self.limits.missing
        here = last - begun + 1.0 / rate
        if length - here > max(seconds, part * length):
            reason = (
                f"its pictures end after {here:.2f} of {length:.2f} s: it is damaged or cut off"
            )
            raise _unreadable(self.path, self.code, reason)

    def _check_size(self, width: int, height: int) -> None:
        least = self.limits.least_side
        most = self.limits.most_pixels
        if min(width, height) < least or width * height > most:
            message = (
                f"{self.path.name}: frames of {width} x {height} px: at least {least} a side and "
                f"{most >> 20} million in all are read"
            )
            found = [width, height]
            raise InputError(f"{self.code}.size", message, file=self.path.name, found=found)

    def _refuse_length(self) -> NoReturn:
        most = self.limits.most_frames
        message = f"{self.path.name} has more than {most} frames: cut it"
        raise InputError(f"{self.code}.long", message, file=self.path.name, expected=most)


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(64)
    except OSError:
        return b""


def _is_text(head: bytes) -> bool:
    try:
        return bool(head) and "\0" not in getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return False


def _demuxer(head: bytes) -> str | None:
    """Return FFmpeg's name of what reads a file that begins so; None for no film."""
    if head[4:8] in BOXES:
        return "mov"
    if head.startswith(MATROSKA):
        return "matroska"
    return "avi" if head.startswith(b"RIFF") and head[8:12] == b"AVI " else None


def _open_nothing(url: str, *_: object) -> NoReturn:
    raise ValueError(f"it names another file, {url[:60]}")


def _unreadable(path: Path, code: str, why: str) -> InputError:
    message = f"{path.name} is not a film that can be read: {why}"
    return InputError(f"{code}.unreadable", message, file=path.name)
