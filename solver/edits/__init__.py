"""Edits of a face, one after the other, and expressions replayed on the edited person."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError
from solver.fitting.face import Face
from solver.mechanics.boundary import Potential
from solver.model import SubjectModel
from solver.similarity import IDENTITY as NO_MOTION
from solver.simulation import Simulator
from solver.simulation.forces import Drive
from solver.surface import Floats

DENSITY = 1e-3  # of flesh, in g/mm^3: water's


@dataclass(frozen=True)
class EditOptions:
    """Limits of edits, and the widths over which they end on the face."""

    # lengths over those at rest that flesh may have with all edits: flesh that grows more finds no
    # rest
    growth: tuple[float, float] = (0.5, 1.8)
    fat_growth: tuple[float, float] = (0.6, 1.5)  # f of fat: flesh grows to f^3 of its volume
    filler_growth: float = 1.35  # f of a tet: above, it would be as large as the flesh around it
    least_room_mm3: float = 1e-9  # flesh that a filler needs
    factor: float = 100.0  # of stiffness or density, at most; at least one over it
    fade_mm: float = 20.0  # from the ends of the model's flesh, where fat ends
    blur_mm: float = 2.0  # by which what is painted runs into its surroundings on the skin
    side_mm: float = 5.0  # half of the way in which a paralysed side passes into the other one
    handle_mm: float = 40.0  # between a handle and its bone


@dataclass(frozen=True)
class Edited:
    """An edited person, which is all that simulations see of edits.

    In ``model`` bones that were moved, and the skin vertices that stay with them (teeth), are where
    they are now. Its flesh, ``rest`` included, is as it was.
    """

    model: SubjectModel
    unedited: SubjectModel  # the person before all edits
    growth: Floats  # (n,) f of F_p = f I of each tet
    stiffness_factor: Floats  # (n,) of the material's stiffness
    density: Floats  # (n,) g/mm^3
    bones: Floats  # (p, 3) mm, added to the rest of vertices on bones: held ones, those that slide
    S: sp.csr_array  # (n, m + 1) blends the activations
    options: EditOptions = EditOptions()

    @classmethod
    def nothing(
        cls, model: SubjectModel, S: sp.csr_array, options: EditOptions = EditOptions()
    ) -> Edited:
        """Return the face as it is."""
        ones = np.ones(len(model.tets))
        return cls(model, model, ones, ones, DENSITY * ones, np.zeros_like(model.rest), S, options)


class AnatomyChange(Protocol):
    """A change of a person's anatomy, by what it does to all edits before it."""

    def __call__(self, before: Edited) -> Edited:
        """Return what it makes of ``before``; raises ``scene.*`` if it does not fit the person."""


def apply(
    edits: Iterable[AnatomyChange],
    model: SubjectModel,
    S: sp.csr_array,
    options: EditOptions = EditOptions(),
) -> Edited:
    """Return what all ``edits``, in their order, make of a person with the S (n, m + 1).

    Raises :class:`InputError` as they do, and ``scene.growth`` where together they make flesh grow
    or shrink out of all measure.
    """
    edited = Edited.nothing(model, S, options)
    low, high = options.growth
    for edit in edits:
        edited = edit(edited)
        least = float(edited.growth.min())
        most = float(edited.growth.max())
        if least < low or most > high:
            found = least if least < low else most
            growth = f"the edits together make flesh grow to {found:.2f} of its length"
            reason = f"{growth}: it can be {low} to {high}"
            raise InputError("scene.growth", reason, found=round(found, 3))
    return edited


@dataclass(frozen=True)
class ReplayOptions:
    """Options of the way from rest to an expression."""

    seconds: float = 1.0  # that it counts as taking, for friction
    steps: int = 4  # in one of them lips would be pressed through each other, or buckle


@dataclass(frozen=True)
class Replayed:
    """An equilibrium: vertices ``x`` (p, 3), the ``skin`` (V, 3), both in mm, and the ``jaw`` (5,).

    ``inverted`` tets there are, and the ``seconds`` that it took to find from the person's rest.
    """

    x: Floats
    skin: Floats
    jaw: Floats
    inverted: int
    seconds: float


class EditReplay:
    """An edited person, quasi-static, from whose rest every expression starts.

    ``face`` has the edits' stiffness, growth and bones, ``potentials`` are its contacts. Raises
    :class:`~solver.errors.SolveError` where the edited person finds no rest.
    """

    def __init__(
        self,
        edited: Edited,
        face: Face,
        potentials: Sequence[Potential],
        options: ReplayOptions = ReplayOptions(),
    ) -> None:
        begun = perf_counter()
        self._options = options
        self._face = face
        self._simulator = Simulator(face, potentials, [], dynamic=False, density=edited.density)
        self._drive = Drive(0.0, face.flesh.passive(), np.zeros(5), NO_MOTION)
        self._rest = self._simulator.rest(self._drive)
        # the edited person at rest
        self.neutral = self._measure(self._rest.x, self._drive.jaw, begun)

    def pose(self, A: Floats, jaw: Floats) -> Replayed:
        """Return the equilibrium for activations ``A`` (n, 6) of the tets and a ``jaw`` (5,).

        Raises :class:`~solver.errors.SolveError` if there is none.
        """
        begun = perf_counter()
        goal = Drive(self._options.seconds, A, jaw, NO_MOTION)
        motion = self._rest
        drive = self._drive
        for part in np.arange(1, self._options.steps + 1) / self._options.steps:
            target = self._drive.toward(goal, float(part))
            motion = self._simulator.step(motion, drive, target).motion
            drive = target
        return self._measure(motion.x, jaw, begun)

    def _measure(self, x: Floats, jaw: Floats, begun: float) -> Replayed:
        face = self._face
        seconds = perf_counter() - begun
        return Replayed(x, face.whole_skin(x, jaw), jaw, face.flesh.count_inverted(x), seconds)
