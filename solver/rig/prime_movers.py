"""Prime movers: the muscles that contract in an expression, against those that literature names.

A muscle's contraction is 1 - the mean stretch of its fibres: positive where it shortens. An action
unit of the expression is judged on its side of the face, with the muscles of that side and of the
middle: the first of its muscles should be among the few that contract most, apart from those that
other units of the expression call for. A muscle of the unit that lengthens contradicts it, and so
does an antagonist that contracts more than its muscles do.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solver.anatomy.action_units import Action, template_names
from solver.drawing.head import both_sides, muscle_side
from solver.surface import Floats


@dataclass(frozen=True)
class MoverOptions:
    """What counts as contracting, and as a prime mover."""

    least: float = 0.02  # contraction below it counts as rest
    contrary: float = 0.05  # lengthening, or an antagonist's contraction, that contradicts
    places: int = 3  # a prime mover is among so many that contract most


@dataclass(frozen=True)
class ActionCheck:
    """An action's muscles in one expression; muscles have the template's names.

    ``rank`` is the place of the first of ``muscles`` among those that contract, from 1; None where
    none of them contracts, and where the template has none of them (``muscles`` is empty then, and
    the action is not judged).
    """

    action: Action
    muscles: tuple[str, ...]
    missing: tuple[str, ...]  # muscles of the unit that the template lacks
    rank: int | None
    ahead: tuple[str, ...]  # that contract more than the first of ``muscles``, strongest first
    lengthened: tuple[str, ...]  # of ``muscles``
    opposed: tuple[str, ...]  # antagonists that contract, and more than ``muscles`` do
    places: int

    @property
    def is_judged(self) -> bool:
        """Whether the template has a muscle of the unit."""
        return bool(self.muscles)

    @property
    def is_prime(self) -> bool:
        """Whether one of the muscles is among the few that contract most."""
        return self.rank is not None and self.rank <= self.places


@dataclass(frozen=True)
class Movers:
    """Who contracts in an expression (muscle -> contraction, most first), and its actions."""

    contractions: dict[str, float]
    actions: tuple[ActionCheck, ...]

    def contradictions(self) -> list[str]:
        """Return in words what contradicts the literature."""
        words = []
        for check in self.actions:
            code = check.action.unit.code
            for muscle in check.lengthened:
                percent = -100.0 * self.contractions[muscle]
                words.append(f"{muscle} lengthens by {percent:.0f} %, which makes {code}")
            for muscle in check.opposed:
                percent = 100.0 * self.contractions[muscle]
                words.append(f"{muscle} contracts by {percent:.0f} %, against {code}")
        return list(dict.fromkeys(words))


def movers(
    contractions: Mapping[str, float],
    actions: Iterable[Action],
    options: MoverOptions = MoverOptions(),
) -> Movers:
    """Judge the ``actions`` of an expression by the ``contractions`` of :func:`ranked`."""
    actions = tuple(actions)
    return Movers(
        dict(contractions),
        tuple(_check(contractions, action, actions, options) for action in actions),
    )


def ranked(names: Sequence[str], fibres: Floats, judged: NDArray[np.bool_]) -> dict[str, float]:
    """Return muscle -> contraction, most first; ``fibres`` (m,) are mean stretches.

    Muscles that are not ``judged`` (m,) are left out, and those without fibres (NaN).
    """
    contraction = 1.0 - fibres
    order = np.argsort(-contraction, kind="stable")
    return {
        names[j]: float(contraction[j]) for j in order if judged[j] and np.isfinite(contraction[j])
    }


def _check(
    contractions: Mapping[str, float],
    action: Action,
    actions: tuple[Action, ...],
    options: MoverOptions,
) -> ActionCheck:
    unit = action.unit
    near = [name for name in contractions if muscle_side(name) in (action.side, "")]
    mine = [name for name in near if is_one_of(name, unit.muscles)]
    called = [muscle for unit, side in actions if side == action.side for muscle in unit.muscles]
    most = max((contractions[name] for name in mine), default=0.0)
    ahead = [
        name
        for name in near
        if contractions[name] > max(most, options.least) and not is_one_of(name, called)
    ]
    return ActionCheck(
        action,
        muscles=tuple(mine),
        missing=tuple(
            muscle for muscle in unit.muscles if not any(is_one_of(name, [muscle]) for name in near)
        ),
        rank=len(ahead) + 1 if most >= options.least else None,
        ahead=tuple(ahead),
        lengthened=tuple(name for name in mine if contractions[name] <= -options.contrary),
        opposed=tuple(
            name
            for name in ahead
            if contractions[name] >= options.contrary and is_one_of(name, unit.antagonists)
        ),
        places=options.places,
    )


def is_one_of(name: str, muscles: Iterable[str]) -> bool:
    """Whether a template's muscle is one of ``muscles`` of anatomy texts."""
    bare = both_sides(name).lower()
    return any(bare in template_names(muscle) for muscle in muscles)
