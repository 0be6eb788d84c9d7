"""A scratch copy of the tree, in which one fault at a time is planted."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.campaigns.faults.catalogue import Fault

ROOMS = ("solver", "service", "worker", "myoface")
SUFFIXES = {".py", ".js"}
LEFT_OUT = (".git", ".venv", "__pycache__", ".*_cache", "node_modules", "*.egg-info")
NAME = r"[\w.]+"
KERNELS = re.compile(r"\bn(um)?ba?\.njit|@njit|from numba|import numba")


class NotPlantedError(Exception):
    """Tell why a fault cannot be planted: its place is not found, or not the only one."""


@dataclass(frozen=True)
class Place:
    """Where a fault goes: the ``text`` of ``path`` becomes ``faulty``."""

    path: Path
    text: str
    faulty: str

    @property
    def is_compiled(self) -> bool:
        """Whether kernels are compiled from this file: those of other files may hold them."""
        return KERNELS.search(self.text) is not None


class Tree:
    """A copy of ``root`` at ``scratch/tree``, beside a link to the shared data.

    Times of files are kept, so that compiled kernels of an earlier run go on being used.
    """

    def __init__(self, root: Path, scratch: Path) -> None:
        self.path = scratch / "tree"
        shutil.rmtree(self.path, ignore_errors=True)
        shutil.copytree(root, self.path, symlinks=True, ignore=shutil.ignore_patterns(*LEFT_OUT))
        shared = root.parent / "shared"
        link = scratch / "shared"
        if shared.exists() and not link.exists():
            link.symlink_to(shared.resolve())
        self._texts = {
            path: path.read_text()
            for room in ROOMS
            for path in sorted((self.path / room).rglob("*"))
            if path.suffix in SUFFIXES and "vendor" not in path.parts
        }

    def find(self, fault: Fault) -> list[Place]:
        """Return the only place of a fault, two of twins, by the first change that fits."""
        counts = []
        for old, new in fault.changes:
            places = [place for path in self._texts for place in self._fitting(path, old, new)]
            if len(places) == 1 or (fault.twins and len({place.path for place in places}) == 2):
                return places
            counts.append(len(places))
        raise NotPlantedError(f"found {' and '.join(map(str, counts))} times, not once")

    @contextmanager
    def planted(self, places: list[Place]) -> Iterator[None]:
        """Have a fault in the tree for as long as the context lasts."""
        times = [place.path.stat() for place in places]
        for place in places:
            place.path.write_text(place.faulty)
        try:
            yield
        finally:
            for place, time in zip(places, times, strict=True):
                place.path.write_text(place.text)
                os.utime(place.path, ns=(time.st_atime_ns, time.st_mtime_ns))

    def _fitting(self, path: Path, old: str, new: str) -> Iterator[Place]:
        text = self._texts[path]
        dense, positions = _without_space(text)
        for found in re.finditer(_pattern(old), dense):
            first = positions[found.start()]
            last = positions[found.end() - 1]
            planted = new
            for number, name in found.groupdict().items():
                planted = planted.replace(f"${number[1:]}", name)
            yield Place(path, text, text[:first] + planted + text[last + 1 :])


def _without_space(text: str) -> tuple[str, list[int]]:
    """Return ``text`` without white space, and where its characters stood."""
    positions = [at for at, character in enumerate(text) if not character.isspace()]
    return "".join(text[at] for at in positions), positions


def _pattern(snippet: str) -> str:
    """Return a pattern of ``snippet`` without white space, in which ``$1`` is any name."""
    seen: set[str] = set()
    pattern = ""
    for part in re.split(r"(\$\d)", "".join(snippet.split())):
        if not re.fullmatch(r"\$\d", part):
            pattern += re.escape(part)
        elif part in seen:
            pattern += f"(?P=n{part[1]})"
        else:
            seen.add(part)
            pattern += f"(?P<n{part[1]}>{NAME})"
    return pattern
