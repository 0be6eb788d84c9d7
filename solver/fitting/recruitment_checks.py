"""What recruitment found of scans that is odd: nobody to expect, a motion, a name.

Recruitment (:mod:`solver.fitting.recruitment`) explains a scan by the template's expressions. This
tells where it cannot, and where a scan's name says other units of FACS than its motion, as that of
a frown in a file that is called smile.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solver.anatomy.action_units import SIDES, Action, actions_of, joined_codes
from solver.errors import Finding, make_warning
from solver.fitting.face import Face
from solver.fitting.objective import Target
from solver.fitting.recruitment import Recruitment, why_none
from solver.surface import Floats


@dataclass(frozen=True)
class RecruitmentLimits:
    """Limits beyond which what recruitment found of a target is told.

    docs/science/anatomy.md says how far right scans and odd ones are from them.
    """

    moved_mm: float = 1.0  # mean motion of the face; less may be the noise of a registration
    explained: float = 0.5  # of the squared motion, at least
    named: float = 0.2  # greatest amount of an expression with the name's units, at least, or ...
    by_name: float = 0.5  # ... these alone explain so much of what all do
    weak: float = 0.2  # amount of the name's units on one side by that on the other, at least
    shown: float = 0.5  # part of an expression's squared motion that the target sees, at least
    strongest: int = 3  # expressions that are told of what a scan shows instead
    # what people make on one side, though tables of units do not say so
    one_sided: tuple[str, ...] = ("contempt",)


def check_expected(face: Face) -> list[Finding]:
    """Return whether nothing is expected of the muscles of a face, whatever is fitted."""
    reason = why_none(face)
    if not reason:
        return []
    message = (
        f"{reason}: no muscle is expected to pull in any expression, so that more of them do than "
        "anatomy says"
    )
    return [make_warning("recruitment.none", message)]


def check_recruitment(
    face: Face, targets: Mapping[str, Target], limits: RecruitmentLimits = RecruitmentLimits()
) -> list[Finding]:
    """Return what is odd about what the muscles of a face are expected to do in ``targets``."""
    recruitment = Recruitment.of_face(face)
    if recruitment is None:
        return check_expected(face)
    found = []
    for name, target in targets.items():
        motion = (target.points - recruitment.rest)[target.weights > 0.0]
        if np.linalg.norm(motion, axis=1).mean() >= limits.moved_mm:
            found += _check_target(recruitment, name, target, limits)
    return found


def _check_target(
    recruitment: Recruitment, name: str, target: Target, limits: RecruitmentLimits
) -> list[Finding]:
    amounts, explained = recruitment.amounts(target)
    if explained < limits.explained:
        message = (
            f"{name}: the template's expressions explain {100 * explained:.0f} % of its motion, so "
            "that muscles are hardly expected to do anything: an odd scan, or a face that does "
            "what theirs do not"
        )
        context = {"expression": name, "explained": round(explained, 3)}
        return [make_warning("target.unexplained", message, context)]
    said = said_actions(name)
    shown = _shown(recruitment, target, limits)
    by_side = {side: shown & _have(recruitment, said, side) for side in SIDES}
    most = {side: float(np.max(amounts[each], initial=0.0)) for side, each in by_side.items()}
    own = by_side["left"] | by_side["right"]
    if not own.any():  # a name that says nothing, or what no expression shows
        return []
    if max(most.values()) < limits.named:
        if recruitment.explained_by(target, own) >= limits.by_name * explained:
            return []  # by other expressions that move alike
        return [_tell_name(recruitment, name, said, amounts, limits)]
    weak, strong = sorted(SIDES, key=lambda side: most[side])
    is_said_of_both = all(each.any() for each in by_side.values())
    if is_said_of_both and most[weak] < limits.weak * most[strong]:
        return [] if name in limits.one_sided else [_tell_side(name, said, weak, most)]
    return []


def said_actions(name: str) -> tuple[Action, ...]:
    """Return the actions that a scan's name says, which may have a number at its end."""
    return actions_of(name) or actions_of(re.sub(r"[\s_.-]*\d+$", "", name))


def _shown(
    recruitment: Recruitment, target: Target, limits: RecruitmentLimits
) -> NDArray[np.bool_]:
    """Tell which expressions (e,) a target shows if they are made, of those of the template."""
    squares = np.square(recruitment.motions, dtype=np.float64).sum(axis=2)
    seen = squares[:, target.weights > 0.0].sum(axis=1)
    return np.asarray(recruitment.shown & (seen > limits.shown * squares.sum(axis=1)))


def _have(recruitment: Recruitment, said: tuple[Action, ...], side: str) -> NDArray[np.bool_]:
    """Tell of expressions (e,) whether they have one of the actions ``said`` of a side."""
    of_side = {action for action in said if action.side == side}
    return np.array([not of_side.isdisjoint(actions_of(each)) for each in recruitment.names])


def _tell_name(
    recruitment: Recruitment,
    name: str,
    said: tuple[Action, ...],
    amounts: Floats,
    limits: RecruitmentLimits,
) -> Finding:
    moved = amounts * np.linalg.norm(recruitment.motions, axis=2).mean(axis=1)
    strongest = np.argsort(-moved)[: limits.strongest].tolist()
    shows = {recruitment.names[each]: round(float(amounts[each]), 2) for each in strongest}
    codes = joined_codes(action.unit for action in said)
    words = ", ".join(f"{each} by {amount:.2f}" for each, amount in shows.items())
    message = (
        f"{name}: its name says {codes}, which its motion does not have; it is that of {words}: "
        "see whether the scan has the name of another one"
    )
    return make_warning(
        "target.name", message, {"expression": name, "units": codes, "shows": shows}
    )


def _tell_side(
    name: str, said: tuple[Action, ...], weak: str, most: Mapping[str, float]
) -> Finding:
    codes = joined_codes(action.unit for action in said)
    amounts = {side: round(amount, 2) for side, amount in most.items()}
    message = (
        f"{name}: its {weak} side makes hardly anything of {codes} (left {most['left']:.2f}, right "
        f"{most['right']:.2f} of the template's expressions): a palsy, or an expression of one side"
    )
    context = {"expression": name, "side": weak, "units": codes, "amounts": amounts}
    return make_warning("target.one_sided", message, context)
