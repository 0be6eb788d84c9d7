"""Pairs that controls are learned from: a mixture of a template's shapes, and its exact solve.

Walks go from rest to one mixture after another in short steps, and each stop is fitted from the one
before as a frame of a performance is. There is no contact in them: a simulation adds it.
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

from solver.anatomy.template import CORRECTED
from solver.animation.controls.exact import MixtureTracker
from solver.animation.controls.metric import changes_of
from solver.animation.controls.skin import SkinModes
from solver.errors import InputError, SolveError
from solver.fitting.expression_basis import face_identity
from solver.fitting.face import Face
from solver.kinds import FILES
from solver.mechanics.linear import in_threads
from solver.scans.openface import shapes_of_units
from solver.scans.performance import ARKIT_NAMES
from solver.storage import Archive
from solver.surface import Floats, Ints
from solver.templates.ict_facekit import arkit_source

FILE = "control_pairs.npz"
FORMAT = FILES[FILE].format
LEVELS = (0.25, 0.5, 0.75, 1.0)  # of each shape alone


@dataclass(frozen=True)
class WalkOptions:
    """Mixtures that walks go to, and the stops on their way."""

    step: float = 1.0  # greatest sum of the weights' changes from stop to stop
    stops: int = 120  # of a walk
    # parts of the mixtures that are of action units, alike on both sides, and of many shapes
    units: float = 0.3
    dense: float = 0.25
    most_units: int = 6
    most_shapes: int = 6  # of a mixture that is not dense
    most_dense: int = 16
    opens_jaw: float = 0.4  # part of the mixtures of shapes in which the jaw opens as well
    alike: float = 0.5  # part of them in which both sides of a shape move alike
    rest: float = 0.03  # part of the mixtures that are rest


@dataclass(frozen=True, eq=False)
class Mixtures:
    """Weights (e,) that shapes ``names`` can have together, drawn at random."""

    names: tuple[str, ...]
    options: WalkOptions = WalkOptions()

    def draw(self, random: np.random.Generator) -> Floats:
        """Return weights (e,) from 0 to 1."""
        given = self.options
        weights = np.zeros(len(self.names))
        kind = random.random()
        if kind < given.rest:
            return weights
        if kind < given.rest + given.units:
            return self.of_units(self.draw_units(random))
        dense = kind > 1.0 - given.dense
        most = min(given.most_dense if dense else given.most_shapes, len(self.names))
        least = min(given.most_shapes, most) if dense else 1
        count = int(random.integers(least, most + 1))
        chosen = random.choice(len(self.names), count, replace=False)
        # many shapes at once are rarely strong
        weights[chosen] = random.beta(1.0, 2.0 if dense else 1.0, count)
        if random.random() < given.alike:
            for name, other in self._sides:
                weights[other] = weights[name]
        if "jawOpen" in self.names and random.random() < given.opens_jaw:
            weights[self.names.index("jawOpen")] = random.random()
        return self.possible(weights)

    def draw_units(self, random: np.random.Generator, least: int = 1) -> Floats:
        """Return intensities (17,) from 0 to 1 of so many action units or more."""
        moving = np.flatnonzero(self._units.any(axis=1))
        count = int(random.integers(least, self.options.most_units + 1))
        chosen = random.choice(moving, min(count, len(moving)), replace=False)
        intensities = np.zeros(len(self._units))
        intensities[chosen] = random.random(len(chosen))
        return intensities

    def of_units(self, intensities: Floats) -> Floats:
        """Return the weights (e,) of action units (17,), both sides alike."""
        return self.possible(intensities @ self._units)

    def possible(self, weights: Floats) -> Floats:
        """Return weights from 0 to 1, a corrective's no greater than that of what it corrects."""
        weights = np.clip(weights, 0.0, 1.0)
        for name, corrected in CORRECTED.items():
            if name in self.names:
                with_it = weights[self.names.index(corrected)] if corrected in self.names else 0.0
                weights[self.names.index(name)] = min(weights[self.names.index(name)], with_it)
        return weights

    def alone(self) -> list[Floats]:
        """Return each shape by itself at several levels, a corrective on what it corrects."""
        found = []
        for number, name in enumerate(self.names):
            weights = np.zeros(len(self.names))
            weights[number] = 1.0
            if CORRECTED.get(name) in self.names:
                weights[self.names.index(CORRECTED[name])] = 1.0
            found += [self.possible(level * weights) for level in LEVELS]
        return found

    @property
    def _units(self) -> Floats:
        """Weights (17, e) of each action unit at full intensity; some move nothing."""
        columns = [ARKIT_NAMES.index(arkit_source(name)) for name in self.names]
        return shapes_of_units()[:, columns]

    @property
    def _sides(self) -> list[tuple[int, int]]:
        """Places of the left and the right one of each shape that has both."""
        pairs = {name: name.removesuffix("Left") + "Right" for name in self.names}
        return [
            (self.names.index(name), self.names.index(other))
            for name, other in pairs.items()
            if name.endswith("Left") and other in self.names
        ]


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
        }
        modes = {"rest": self.modes.rest, "modes": self.modes.modes}
        Archive(header, {**singles, **modes}).write(path)

    @classmethod
    def load(cls, path: Path, face: Face, names: Sequence[str]) -> Pairs:
        """Read pairs that :meth:`save` wrote of ``face``.

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
class Walks:
    """Walks on a ``face`` through mixtures of shapes, ``motions`` (e, k, 3) of its points in mm.

    Walk 0 goes through every shape alone, walk n through what the n-th generator of ``seed``
    draws, so that each is the same whatever ran before it. Skins are reduced to ``modes``, if
    these are known.
    """

    face: Face
    mixtures: Mixtures
    motions: Floats
    seed: int = 0
    modes: SkinModes | None = None

    def stops(self, number: int) -> list[Floats]:
        """Return the mixtures (e,) that a walk stops at."""
        given = self.mixtures.options
        if number == 0:
            return self.mixtures.alone()
        random = np.random.default_rng((self.seed, number))
        at = np.zeros(len(self.mixtures.names))
        found = list[Floats]()
        while len(found) < given.stops:
            goal = self.mixtures.draw(random)
            parts = max(int(np.ceil(np.abs(goal - at).sum() / given.step)), 1)
            found += [at + (goal - at) * (part + 1) / parts for part in range(parts)]
            at = goal
        return found[: given.stops]

    def walk(self, number: int, tell: Callable[[], None] = lambda: None) -> Walked:
        """Fit a walk's stops; ``tell`` is called at each. Those that cannot be are left out.

        Raises :class:`SolveError` (``controls.few``) if none can be.
        """
        tracker = MixtureTracker(self.face, self.motions)
        rows = list[tuple[Floats, Floats, Floats, float]]()
        failed = 0
        for weights in self.stops(number):
            found = tracker.fit(weights)
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

    if known is None:
        first = walk(walks, range(FIRST_WALKS))
        rows = PairRows.join(each.rows for each in first)
        modes = SkinModes.of(walks.face.model.skin.vertices, rows.skins, MODES)
        failed = sum(each.failed for each in first)
        known = Pairs(walks.mixtures.names, rows.reduced(modes), modes, failed)
        keep(known)
    walks = replace(walks, modes=known.modes)
    while len(known) < count and time.perf_counter() < until:
        begin = int(known.rows.walks.max()) + 1
        known = known.plus(walk(walks, range(begin, begin + nb.get_num_threads())))
        keep(known)
    return known
