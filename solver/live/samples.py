"""Frames that sessions of a rig have solved in full, left for the sessions after them.

The error of a session falls as it goes on, by what full solves tell of the skin; one that begins
with the frames of another begins where that ended. They serve a session of the same reduced skin,
source, markers and learned controls: a file has those of each such sort apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.errors import InputError
from solver.kinds import FILES
from solver.kinds.live_session import Source
from solver.live.skin import LiveSkin
from solver.storage import Archive, hash_file
from solver.surface import Floats

FILE = "live_samples.npz"
FORMAT = FILES[FILE].format
MOST_SORTS = 8  # that a file has, the newest first


@dataclass(frozen=True, eq=False)
class SolvedFrames:
    """Frames that were solved: how far they were ``off`` (n, r) in amounts of the skin.

    ``at`` (n, d) are their features, slider values and clues, each by its scale.
    """

    at: Floats
    off: Floats

    def fits(self, features: int, amounts: int) -> bool:
        """Tell whether they are of so many features and amounts."""
        return self.at.shape == (len(self.off), features) and self.off.shape[1:] == (amounts,)


def sort_of(skin: LiveSkin, source: Source, files: Mapping[str, Path], *, learned: bool) -> str:
    """Return what tells a session's sort: a hash of its skin, source and what else it goes by.

    That is the marker set of markers, and the controls, where the face has ``learned`` ones, of
    sources whose full solves go by them. ``files`` are by their roles.
    """
    about: dict[str, str] = {"source": source}
    if source == "markers":
        about["markers"] = hash_file(files["marker_set"])
    if learned and source in ("weights", "landmarks"):
        about["controls"] = hash_file(files["controls"])
    modes = {
        "directions": skin.sliders.directions,
        "basis": skin.reduced.basis,
        "spare": skin.spare,
    }
    return Archive(about, modes).sha256


def write_samples(path: Path, by_sort: Mapping[str, SolvedFrames]) -> None:
    """Write frames by their sorts, the newest first, but for those beyond :data:`MOST_SORTS`."""
    sorts = [*by_sort][:MOST_SORTS]
    arrays = {
        f"{name}_{number}": getattr(by_sort[sort], name)
        for number, sort in enumerate(sorts)
        for name in ("at", "off")
    }
    Archive({"format": FORMAT, "sorts": sorts}, arrays).write(path, packed=False)


def read_samples(path: Path) -> dict[str, SolvedFrames]:
    """Return the frames that :func:`write_samples` wrote, by their sorts.

    Raises :class:`InputError`: ``live_samples.unreadable``, ``live_samples.format``.
    """
    archive = Archive.read(path, "live_samples", "a file of solved live frames", FORMAT)
    found = {}
    try:
        for number, sort in enumerate(archive.header["sorts"]):
            at, off = (archive.arrays[f"{name}_{number}"].astype(float) for name in ("at", "off"))
            if at.ndim != 2 or off.ndim != 2 or len(at) != len(off):
                raise ValueError(f"frames have the shapes {at.shape} and {off.shape}")
            if not (np.isfinite(at).all() and np.isfinite(off).all()):
                raise ValueError("a number is not finite")
            found[str(sort)] = SolvedFrames(at, off)
    except (LookupError, TypeError, ValueError) as error:
        reason = f"{path.name} is not a file of solved live frames: {error}"
        raise InputError("live_samples.unreadable", reason, file=path.name) from error
    return found
