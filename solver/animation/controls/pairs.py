"""Pairs that controls are learned from: a mixture of a template's shapes, and its exact solve.

The first walks go from rest to one mixture after another in short steps, and each stop is fitted
from the one before as a frame of a performance is. Later ones jump: a polynomial that is learned
from the first tells where each mixture's fit begins, so that every stop is a mixture of its own,
and of which mixtures it knows least: these are fitted most. There is no contact in them: a
simulation adds it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from solver.animation.controls.exact import MixtureFitOptions, MixtureTracker
from solver.animation.controls.maps import Leverage, PolynomialMap, ShapeSizes
from solver.animation.controls.metric import changes_of, pose_of
from solver.animation.controls.mixtures import Mixtures, WalkOptions
from solver.animation.controls.skin import SkinModes
from solver.errors import InputError, SolveError
from solver.fitting.expression_basis import face_identity
from solver.fitting.face import Face
from solver.kinds import FILES
from solver.mechanics.linear import in_threads
from solver.storage import Archive
from solver.surface import Floats, Ints

FILE = "control_pairs.npz"
FORMAT = FILES[FILE].format

ROWS = ("weights", "changes", "skins", "off_mm", "walks")


@dataclass(frozen=True, eq=False)
class PairRows:
    """Mixtures ``weights`` (n, e), and what solves them.

    ``changes`` (n, 6 m + 5) are activations off the rest and a free jaw, ``skins`` (n, r) the
    skin's coordinates in modes, or (n, v, 3) the skin itself where no modes are known. ``off_mm``
    (n,) is the mean distance to the mixture's own skin. ``walks`` (n,) are the numbers of the
    walks, whose pairs lie in their order.
    """

    weights: Floats
    changes: Floats
    skins: NDArray[np.floating]
    off_mm: Floats
    walks: Ints

    def __len__(self) -> int:
        return len(self.weights)

    def __getitem__(self, rows: NDArray[Any]) -> PairRows:
        """Return some of the pairs."""
        return PairRows(**{name: getattr(self, name)[rows] for name in ROWS})

    @classmethod
    def join(cls, parts: Iterable[PairRows]) -> PairRows:
        """Return the pairs of several walks."""
        all_parts = list(parts)
        return cls(
            **{name: np.concatenate([getattr(part, name) for part in all_parts]) for name in ROWS}
        )

    def reduced(self, modes: SkinModes) -> PairRows:
        """Return the pairs with their skins in ``modes``."""
        return replace(self, skins=_as_kept([modes.reduce(skin) for skin in self.skins]))


def _as_kept(rows: Sequence[Floats | float]) -> Floats:
    """Return an array of rows as a file keeps it: what is learned is the same after a resume."""
    return np.array(rows, np.float32).astype(float)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of the shapes ``names``; ``failed`` counts the stops that were left out."""

    names: tuple[str, ...]
    rows: PairRows
    modes: SkinModes
    failed: int = 0

    def __len__(self) -> int:
        return len(self.rows)

    def plus(self, walks: Sequence[Walked]) -> Pairs:
        """Return these and what further walks found."""
        rows = PairRows.join([self.rows, *(walk.rows for walk in walks)])
        return replace(self, rows=rows, failed=self.failed + sum(walk.failed for walk in walks))

    def save(self, path: Path, face: Face) -> None:
        """Write the pairs as NPZ; they are of ``face``."""
        arrays = {name: getattr(self.rows, name) for name in ROWS}
        singles = {
            name: array.astype(np.float32) if array.dtype.kind == "f" else array
            for name, array in arrays.items()
        }
        header = {
            "format": FORMAT,
            "of": face_identity(face),
            "names": self.names,
            "failed": self.failed,
            "fitted_on": True,
        }
        modes = {"rest": self.modes.rest, "modes": self.modes.modes}
        Archive(header, {**singles, **modes}).write(path)

    @classmethod
    def load(cls, path: Path, face: Face, names: Sequence[str]) -> Pairs:
        """Read pairs that :meth:`save` wrote of ``face``.

        Earlier releases did not fit pairs on where muscles are at their limits: theirs are left out
        that ended far from their mixtures.

        Raises :class:`InputError`: ``control_pairs.unreadable``, ``control_pairs.format``, or
        ``control_pairs.model`` if they are of another rig or of other shapes.
        """
        archive = Archive.read(path, "control_pairs", "a set of pairs", FORMAT)
        header = archive.header
        data = archive.arrays
        if header.get("of") != face_identity(face) or header.get("names") != [*names]:
            reason = f"{path.name} belongs to another rig or template"
            raise InputError("control_pairs.model", reason, file=path.name)
        try:
            arrays = {name: data[name] for name in ROWS}
            rows = PairRows(
                **{
                    name: a.astype(float) if a.dtype.kind == "f" else a
                    for name, a in arrays.items()
                }
            )
            if not header.get("fitted_on"):
                rows = rows[rows.off_mm <= WalkOptions().refit_above_mm]
            modes = SkinModes(data["rest"], data["modes"])
            return cls(tuple(names), rows, modes, int(header["failed"]))
        except (LookupError, TypeError, ValueError) as error:
            reason = f"{path.name} is not a set of pairs: {error}"
            raise InputError("control_pairs.unreadable", reason, file=path.name) from error


@dataclass(frozen=True, eq=False)
class Walked:
    """Pairs of one walk, and the number of its stops that could not be fitted."""

    rows: PairRows
    failed: int


@dataclass(frozen=True, eq=False)
class Guide:
    """What pairs tell of other mixtures: the ``changes`` off the rest, and how little that is."""

    changes: PolynomialMap
    leverage: Leverage

    @classmethod
    def of(cls, rows: PairRows, sizes: ShapeSizes) -> Guide:
        """Learn from pairs."""
        changes = PolynomialMap.learn(rows.weights, rows.changes, sizes)
        return cls(changes, Leverage.of(rows.weights, sizes))


@dataclass(frozen=True, eq=False)
class Walks:
    """Walks on a ``face`` through mixtures of shapes, ``motions`` (e, k, 3) of its points in mm.

    Walk 0 goes through every shape alone, walk n through what the n-th generator of ``seed``
    draws; those that jump depend on the pairs of the ones in steps as well, by the ``guide``. Skins
    are reduced to ``modes``, if these are known.
    """

    face: Face
    mixtures: Mixtures
    motions: Floats
    seed: int = 0
    modes: SkinModes | None = None
    guide: Guide | None = None

    def jumps(self, number: int) -> bool:
        """Tell whether a walk jumps from mixture to mixture."""
        return number >= self.mixtures.options.in_steps

    def guided(self, rows: PairRows) -> Walks:
        """Return the walks with what those in steps tell of mixtures."""
        first = rows[rows.walks < self.mixtures.options.in_steps]
        return replace(self, guide=Guide.of(first, ShapeSizes.of(self.motions)))

    def stops(self, number: int) -> list[Floats]:
        """Return the mixtures (e,) that a walk stops at."""
        given = self.mixtures.options
        if number == 0:
            return self.mixtures.alone()
        random = np.random.default_rng((self.seed, number))
        if self.jumps(number) and self.guide is not None:
            return nearest_next(self._choose(random, self.guide))
        at = np.zeros(len(self.mixtures.names))
        found = list[Floats]()
        while len(found) < given.stops:
            goal = self.mixtures.draw(random)
            parts = max(int(np.ceil(np.abs(goal - at).sum() / given.step)), 1)
            found += [at + (goal - at) * (part + 1) / parts for part in range(parts)]
            at = goal
        return found[: given.stops]

    def _choose(self, random: np.random.Generator, guide: Guide) -> list[Floats]:
        """Return mixtures (e,) of those that are drawn, by how little pairs tell of them."""
        found = []
        for _ in range(self.mixtures.options.stops):
            kind = self.mixtures.draw_kind(random)
            drawn = [self.mixtures.draw(random, kind) for _ in range(self.mixtures.options.choices)]
            unknown = guide.leverage(np.array(drawn)) + 1e-12
            found.append(drawn[int(random.choice(len(drawn), p=unknown / unknown.sum()))])
        return found

    def walk(self, number: int, tell: Callable[[], None] = lambda: None) -> Walked:
        """Fit a walk's stops; ``tell`` is called at each. Those that cannot be are left out.

        Raises :class:`SolveError` (``controls.few``) if none can be.
        """
        given = self.mixtures.options
        fit = MixtureFitOptions(given.refit_above_mm)
        tracker = MixtureTracker(self.face, self.motions, fit)
        rows = list[tuple[Floats, Floats, Floats, float]]()
        failed = 0
        guide = self.guide if self.jumps(number) else None
        for weights in self.stops(number):
            begin = None if guide is None else pose_of(guide.changes(weights))
            found = tracker.fit(weights, begin)
            tell()
            if found is None:
                failed += 1
                continue
            change = changes_of(found.activations, found.jaw)
            seen = found.skin if self.modes is None else self.modes.reduce(found.skin)
            rows.append((weights, change, seen.astype(np.float32), found.off_mm))
        if not rows:
            reason = "no mixture of the template's shapes can be fitted on this rig"
            raise SolveError("controls.few", reason)
        columns = list(zip(*rows, strict=True))
        weights, changes, off = (_as_kept(columns[place]) for place in (0, 1, 3))
        walks = np.full(len(rows), number)
        return Walked(PairRows(weights, changes, np.array(columns[2]), off, walks), failed)


def nearest_next(mixtures: Sequence[Floats]) -> list[Floats]:
    """Return mixtures (e,) in an order in which each is the nearest to the one before, from rest.

    Fits take sensitivities over from one to the next.
    """
    left = list(mixtures)
    found = [np.zeros_like(left[0])]
    while left:
        distances = np.linalg.norm(np.array(left) - found[-1], axis=1)
        found.append(left.pop(int(np.argmin(distances))))
    return found[1:]


MODES = 96  # of the skin: the main ones of the first walks
FIRST_WALKS = 4  # with the one through every shape alone


def solve_pairs(
    walks: Walks,
    count: int,
    known: Pairs | None = None,
    keep: Callable[[Pairs], None] = lambda _pairs: None,
    tell: Callable[[int], None] = lambda _count: None,
    seconds: float = np.inf,
) -> Pairs:
    """Return ``count`` pairs or a few more, ``known`` ones among them.

    ``keep`` gets all pairs so far each time that walks end, ``tell`` hears of their number at every
    stop. After so many ``seconds`` no further walks begin.
    """
    lock = threading.Lock()
    until = time.perf_counter() + seconds
    found = 0 if known is None else len(known)

    def told() -> None:
        nonlocal found
        with lock:
            found += 1
            tell(found)

    def walk(walks: Walks, numbers: Iterable[int]) -> list[Walked]:
        return in_threads(lambda number: walks.walk(number, told), numbers)

    if known is None or not len(known):  # those that an older release left may all be left out
        first = walk(walks, range(FIRST_WALKS))
        rows = PairRows.join(each.rows for each in first)
        modes = SkinModes.of(walks.face.model.skin.vertices, rows.skins, MODES)
        failed = sum(each.failed for each in first)
        known = Pairs(walks.mixtures.names, rows.reduced(modes), modes, failed)
        keep(known)
    walks = replace(walks, modes=known.modes)
    while len(known) < count and time.perf_counter() < until:
        begin = int(known.rows.walks.max()) + 1
        end = begin + nb.get_num_threads()
        if not walks.jumps(begin):
            end = min(end, walks.mixtures.options.in_steps)
        elif walks.guide is None:
            walks = walks.guided(known.rows)
        known = known.plus(walk(walks, range(begin, end)))
        keep(known)
    return known
