"""Prime movers: the muscles that contract in an expression, against those that literature names.

A muscle's contraction is that of :mod:`solver.fitting.contraction`; a whole one counts by the
compartment that contracts most, of those that a unit names if it names a part. An action unit of
the expression is judged on its side of the face, with the muscles of that side and of the middle:
the first of its muscles should be among the few that contract most, apart from those that other
units of the expression call for. A unit none of whose muscles contracts is not what the
expression's name says. A muscle of the unit that lengthens contradicts it, and so does an
antagonist that contracts more than its muscles do.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solver.anatomy.action_units import Action, is_one_of
from solver.drawing.head import muscle_side, other_side
from solver.fitting.contraction import STILL
from solver.surface import Floats


@dataclass(frozen=True)
class MoverOptions:
    """Contractions that count as one, and as a prime mover's."""

    least: float = STILL.least  # contraction below it counts as rest
    lengthened: float = STILL.lengthened  # lengthening from which it contradicts
    opposed: float = 0.05  # contraction of an antagonist that contradicts
    places: int = 3  # a prime mover is among so many that contract most
    uneven: float = 0.1  # difference of both sides that a scan alike on both does not speak for


@dataclass(frozen=True)
class ActionCheck:
    """An action's muscles in one expression.

    Muscles have the template's names; one of several compartments is named by that which contracts
    most. ``rank`` is the place of the first of ``muscles`` among those that contract, from 1; None
    where none of them contracts, and where the template has none of them (``muscles`` is empty
    then, and the action is not judged).
    """

    action: Action
    muscles: tuple[str, ...]
    missing: tuple[str, ...]  # muscles of the unit that the template lacks
    rank: int | None
    ahead: tuple[str, ...]  # that contract more than the first of ``muscles``, strongest first
    idle: tuple[str, ...]  # ``muscles``, where all hold still and only they make the unit
    lengthened: tuple[str, ...]  # of ``muscles``
    opposed: tuple[str, ...]  # antagonists that contract, and more than ``muscles`` do
    places: int

    @property
    def is_judged(self) -> bool:
        """Tell whether the template has a muscle of the unit."""
        return bool(self.muscles)

    @property
    def is_prime(self) -> bool:
        """Tell whether one of the muscles is among the few that contract most."""
        return self.rank is not None and self.rank <= self.places


@dataclass(frozen=True)
class Said:
    """Something odd about a muscle: its name, what it does in words, and how much of it."""

    muscle: str
    words: str
    amount: float

    def __str__(self) -> str:
        """Return the remark as a phrase."""
        return f"{self.muscle} {self.words}"


@dataclass(frozen=True)
class Movers:
    """The muscles that contract in an expression, and its actions.

    ``contractions`` are muscle or compartment -> contraction, most first, and ``wholes`` the muscle
    that each is a compartment of, or itself.
    """

    contractions: dict[str, float]
    wholes: dict[str, str]
    actions: tuple[ActionCheck, ...]

    def contradictions(self) -> list[Said]:
        """Return what contradicts the literature."""
        found = []
        for check in self.actions:
            code = check.action.unit.code
            for muscle in check.lengthened:
                by = -self.contractions[muscle]
                words = f"lengthens by {100.0 * by:.0f} %, which makes {code}"
                found.append(Said(muscle, words, by))
            for muscle in check.opposed:
                by = self.contractions[muscle]
                words = f"contracts by {100.0 * by:.0f} %, against {code}"
                found.append(Said(muscle, words, by))
        return list(dict.fromkeys(found))

    def idle(self) -> list[Said]:
        """Return the muscles that should make an action, and hold still."""
        found = []
        for check in self.actions:
            for muscle in check.idle:
                by = max(self.contractions[muscle], 0.0)
                unit = check.action.unit
                words = f"does not contract ({100.0 * by:.0f} %), which makes {unit.code}"
                found.append(Said(self.wholes[muscle], f"{words}, {unit.name}", -by))
        return list(dict.fromkeys(found))

    def uneven(self) -> list[Said]:
        """Return the muscles that contract more than their partners do, the most uneven first."""
        found = []
        for muscle, by in self.contractions.items():
            partner = other_side(muscle)
            less = max(self.contractions.get(partner, by), 0.0)
            if by > less:
                words = f"contracts by {100.0 * by:.0f} %, {partner} by {100.0 * less:.0f} %"
                found.append(Said(muscle, words, by - less))
        return sorted(found, key=lambda each: -each.amount)


def movers(
    contractions: Mapping[str, float],
    wholes: Mapping[str, str],
    actions: Iterable[Action],
    options: MoverOptions = MoverOptions(),
) -> Movers:
    """Judge an expression's ``actions`` by its ``contractions``, of :func:`rank_contractions`."""
    actions = tuple(actions)
    found = dict(contractions)
    own = {name: wholes[name] for name in found}
    return Movers(
        found, own, tuple(_check(found, own, action, actions, options) for action in actions)
    )


def rank_contractions(
    names: Sequence[str], contraction: Floats, judged: NDArray[np.bool_]
) -> dict[str, float]:
    """Return muscle or compartment -> ``contraction`` (m,), most first.

    Muscles that are not ``judged`` (m,) are left out, and those without fibres (NaN).
    """
    order = np.argsort(-contraction, kind="stable")
    return {
        names[j]: float(contraction[j]) for j in order if judged[j] and np.isfinite(contraction[j])
    }


def _check(
    contractions: Mapping[str, float],
    wholes: Mapping[str, str],
    action: Action,
    actions: tuple[Action, ...],
    options: MoverOptions,
) -> ActionCheck:
    """Judge an action by muscle or compartment -> contraction, most first, and its whole muscle."""
    unit = action.unit
    near = [name for name in contractions if muscle_side(wholes[name]) in (action.side, "")]

    def strongest(names: Iterable[str]) -> list[tuple[str, float]]:
        """Return the one of each whole that contracts most, with its contraction."""
        first: dict[str, str] = {}
        for name in names:
            first.setdefault(wholes[name], name)
        return [(name, contractions[name]) for name in first.values()]

    mine = strongest(name for name in near if is_one_of(name, unit.muscles))
    called = [muscle for unit, side in actions if side == action.side for muscle in unit.muscles]
    most = max((by for _, by in mine), default=0.0)
    others = strongest(name for name in near if not is_one_of(name, called))
    ahead = [(name, by) for name, by in others if by > max(most, options.least)]
    lengthened = tuple(name for name, by in mine if by <= -options.lengthened)
    holds = most < options.least and not lengthened and not unit.by_relaxing
    return ActionCheck(
        action,
        muscles=tuple(name for name, _ in mine),
        missing=tuple(
            muscle for muscle in unit.muscles if not any(is_one_of(name, [muscle]) for name in near)
        ),
        rank=len(ahead) + 1 if most >= options.least else None,
        ahead=tuple(name for name, _ in ahead),
        idle=tuple(name for name, _ in mine) if holds else (),
        lengthened=lengthened,
        opposed=tuple(
            name
            for name, by in ahead
            if by >= options.opposed and is_one_of(name, unit.antagonists)
        ),
        places=options.places,
    )
