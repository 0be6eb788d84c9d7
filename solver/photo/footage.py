"""The pictures of a film: photographs in their order or a ZIP of them, or a film's file.

Frames come one after the other and are never all in memory; to go back is to begin anew.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from solver.errors import InputError, file_error, quote, quote_names
from solver.kinds import MOST_FILM_FRAMES, ROLES
from solver.kinds.inputs import ARCHIVES
from solver.meshio.archive import ArchiveLimits, Member, unpacked
from solver.photo.photo import Photo
from solver.photo.picture import LEAST_SIDE, MOST_PIXELS
from solver.photo.read import read_photo
from solver.scans.film import FilmLimits, FilmPicture, decode_film
from solver.storage import natural_order

LIMITS = FilmLimits(LEAST_SIDE, MOST_PIXELS, MOST_FILM_FRAMES)
# a JSON beside each picture
PICTURE_LIMITS = ArchiveLimits(4 << 30, 2 * MOST_FILM_FRAMES, "film.unreadable", "its pictures")


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


@dataclass(frozen=True)
class Pictures:
    """Photographs by their names, with the files that lie beside them, in natural order."""

    name: str
    paths: Mapping[str, Path]
    facts: Mapping[str, Path] = field(default_factory=dict)
    masks: Mapping[str, Path] = field(default_factory=dict)
    landmarks: Collection[str] = ()  # that a template of one's own has

    @cached_property
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

    Raises :class:`InputError` (``film.*``) as :func:`~solver.scans.film.decode_film`.
    """

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self._path = path
        self._frames: Iterator[FilmPicture] = iter(())
        self._next = 0
        # files only claim to know it
        self._count = sum(1 for _ in decode_film(path, limits=LIMITS))

    def __len__(self) -> int:
        """Return how many frames it has."""
        return self._count

    def number(self, name: str) -> int | None:
        """Return the number that the name is; None if there is no such frame."""
        return int(name) if name.isdecimal() and int(name) < self._count else None

    def photo(self, number: int) -> Photo:
        """Return a frame; raises :class:`InputError` (``film.unreadable``)."""
        if number < self._next or not self._next:
            self._frames = decode_film(self._path, limits=LIMITS)
            self._next = 0
        for picture in self._frames:
            self._next += 1
            if self._next > number:
                shown = picture.pixels().astype(np.float32) / np.float32(255)
                return Photo(f"{Path(self.name).stem} {number}", shown)
        message = f"{self.name} is not a film that can be read: it ends before frame {number}"
        raise InputError("film.unreadable", message, file=self.name)


@contextmanager
def open_film(path: Path, landmarks: Collection[str] = ()) -> Iterator[Footage]:
    """Give the frames of a file, a folder of pictures, or a ZIP of them, for a while unpacked.

    Raises as :class:`FilmFile` and :func:`open_pictures`, and for a ZIP that cannot be unpacked,
    holds pictures in several folders or unpacks to too much ``film.unreadable``.
    """
    if path.is_dir():
        yield open_pictures(path, landmarks, path.name)
        return
    if path.suffix.lower() not in ARCHIVES:
        yield FilmFile(path)
        return
    kinds = (*ROLES["photo"].formats, *ROLES["photo"].landmarks)

    def pictures(members: Sequence[Member]) -> list[Member]:
        """Return the pictures of an archive and what is known of them."""
        folders = sorted(
            {
                str(place.parent)
                for place, _ in members
                if place.suffix.lower() in ROLES["photo"].formats
            }
        )
        if len(folders) > 1:
            reason = f"a ZIP of a film has pictures in one folder, not in {quote_names(folders)}"
            raise file_error(PICTURE_LIMITS.code, path.name, reason, found=folders)
        return [
            each
            for each in members
            if each[0].suffix.lower() in kinds and str(each[0].parent) in folders
        ]

    with unpacked(path, PICTURE_LIMITS, pictures) as folder:
        yield open_pictures(folder, landmarks, path.name)


def open_pictures(path: Path, landmarks: Collection[str], film: str) -> Pictures:
    """Return the frames of a folder of pictures, a ``film`` that is called so.

    What is known of a picture lies beside it: JSON of the same name. ``landmarks`` are a template's
    own. Raises :class:`InputError`: ``film.unreadable`` without any or for two of one name,
    ``film.long`` for too many.
    """
    pictures = [
        each
        for each in path.iterdir()
        if each.suffix.lower() in ROLES["photo"].formats and not each.name.startswith(".")
    ]
    paths = {each.stem: each for each in pictures}
    for name, count in Counter(each.stem for each in pictures).items():
        if count > 1:
            message = f"{film} has two pictures called {quote(name)}"
            raise InputError("film.unreadable", message, file=film, found=name)
    facts = {name: each for name in paths if (each := path / f"{name}.json").is_file()}
    if not paths:
        raise InputError("film.unreadable", f"{film} has no pictures", file=film)
    if len(paths) > MOST_FILM_FRAMES:
        message = f"{film} has {len(paths)} pictures, more than {MOST_FILM_FRAMES}"
        raise InputError("film.long", message, file=film, found=len(paths))
    return Pictures(film, paths, facts, landmarks=landmarks)
