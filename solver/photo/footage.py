"""The pictures of a film: photographs in their order, or a file of MP4 or MOV.

Files of films are read by PyAV (the extra ``video``); every frame is turned upright. Frames come
one after the other and are never all in memory; to go back is to begin anew.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from solver.errors import InputError
from solver.kinds import MOST_FILM_FRAMES, ROLES
from solver.photo.photo import Photo
from solver.photo.picture import LEAST_SIDE, MOST_PIXELS
from solver.photo.read import read_photo

QUARTERS = 4  # turns that make a whole one


class Footage(Protocol):
    """Pictures of one size, the first being number 0."""

    @property
    def name(self) -> str:
        """Return what it is called."""

    def __len__(self) -> int:
        """Return how many frames it has."""

    def photo(self, number: int) -> Photo:
        """Return a frame; raises what is wrong with it."""

    def number(self, name: str) -> int | None:
        """Return the number of the frame that is called so; None if none is."""


def natural_order(names: Collection[str]) -> list[str]:
    """Return names with the numbers in them in order: ``a2`` before ``a10``."""
    parts = {name: re.split(r"(\d+)", name.lower()) for name in names}
    return sorted(
        names, key=lambda name: [int(p) if k % 2 else p for k, p in enumerate(parts[name])]
    )


@dataclass(frozen=True)
class Pictures:
    """Photographs by their names, with the files that lie beside them, in natural order."""

    name: str
    paths: Mapping[str, Path]
    facts: Mapping[str, Path] = field(default_factory=dict)
    masks: Mapping[str, Path] = field(default_factory=dict)
    landmarks: Collection[str] = ()  # that a template of one's own has

    @property
    def order(self) -> list[str]:
        """The names of the frames."""
        return natural_order(self.paths)

    def __len__(self) -> int:
        """Return how many frames there are."""
        return len(self.paths)

    def number(self, name: str) -> int | None:
        """Return the number of the picture of this name; None if there is none."""
        return self.order.index(name) if name in self.paths else None

    def photo(self, number: int) -> Photo:
        """Return a frame; raises :class:`InputError` as :func:`~solver.photo.read.read_photo`."""
        name = self.order[number]
        beside = self.facts.get(name), self.masks.get(name)
        try:
            return replace(read_photo(self.paths[name], *beside, self.landmarks), name=name)
        except InputError as error:
            error.context.setdefault("photo", name)
            raise


class FilmFile:
    """The frames of a file.

    Raises :class:`InputError`: ``film.extra`` without PyAV, ``film.unreadable`` for what is no
    film, ``film.size`` for frames that are too small or too large, ``film.long`` for too many.
    """

    def __init__(self, path: Path) -> None:
        if find_spec("av") is None:
            message = "reading a film needs PyAV, which is not installed: pip install "
            raise InputError("film.extra", f"{message}'myoface[video]', or give its pictures")
        self.name = path.name
        self._path = path
        self._frames: Iterator[Any] = iter(())
        self._next = 0
        self._count = self._look()

    def __len__(self) -> int:
        """Return how many frames it has."""
        return self._count

    def number(self, name: str) -> int | None:
        """Return the number that the name is; None if there is no such frame."""
        return int(name) if name.isdecimal() and int(name) < self._count else None

    def photo(self, number: int) -> Photo:
        """Return a frame; raises :class:`InputError` (``film.unreadable``)."""
        if number < self._next or not self._next:
            self._frames = self._decode()
            self._next = 0
        for picture in self._frames:
            self._next += 1
            if self._next > number:
                pixels = np.rot90(picture.to_ndarray(format="rgb24"), _quarters(picture))
                shown = pixels.astype(np.float32) / np.float32(255)
                return Photo(f"{Path(self.name).stem} {number}", shown)
        raise self._unreadable(f"it ends before frame {number}")

    def _look(self) -> int:
        """Return the number of frames: they are decoded once, as files only claim to know it."""
        count = 0
        for picture in self._decode():
            count += 1
            sides = (picture.width, picture.height)
            if min(sides) < LEAST_SIDE or sides[0] * sides[1] > MOST_PIXELS:
                message = (
                    f"{self.name}: frames of {sides[0]} x {sides[1]} px: at least {LEAST_SIDE} a "
                    f"side and {MOST_PIXELS >> 20} million in all are read"
                )
                raise InputError("film.size", message, file=self.name, found=list(sides))
            if count > MOST_FILM_FRAMES:
                message = f"{self.name} has more than {MOST_FILM_FRAMES} frames: cut it"
                raise InputError("film.long", message, file=self.name, expected=MOST_FILM_FRAMES)
        if not count:
            raise self._unreadable("it has no frames")
        return count

    def _decode(self) -> Iterator[Any]:
        import av

        try:
            with av.open(str(self._path)) as film:
                if not film.streams.video:
                    raise self._unreadable("it has no pictures")
                yield from film.decode(film.streams.video[0])
        except (av.FFmpegError, OSError, ValueError) as error:
            raise self._unreadable(str(error)) from error

    def _unreadable(self, why: str) -> InputError:
        message = f"{self.name} is not a film that can be read: {why}"
        return InputError("film.unreadable", message, file=self.name)


def _quarters(picture: Any) -> int:
    """Return by how many quarters, to the left, a frame is turned to stand upright."""
    return int(round(picture.rotation / 90) % QUARTERS)


def open_film(path: Path, landmarks: Collection[str] = ()) -> Footage:
    """Return the frames of a file, or of a folder of pictures; raises as :class:`FilmFile`.

    What is known of a picture of a folder lies beside it: JSON of the same name. ``landmarks`` are
    a template's own.
    """
    if not path.is_dir():
        return FilmFile(path)
    pictures = [each for each in path.iterdir() if each.suffix.lower() in ROLES["photo"].formats]
    paths = {each.stem: each for each in pictures}
    facts = {name: each for name in paths if (each := path / f"{name}.json").is_file()}
    if not paths:
        raise InputError("film.unreadable", f"{path.name} has no pictures", file=path.name)
    return Pictures(path.name, paths, facts, landmarks=landmarks)
