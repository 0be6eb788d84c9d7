"""Proposals of what to scan next: the template's expressions, ranked by their expected gain.

Every shape of the template that muscles make, both sides of it together, is put on the person's
neutral, fitted roughly with the S that is known so far, and linearised there
(:mod:`solver.fitting.geometry_information`). Fits begin with what an
:class:`~solver.fitting.expression_basis.ExpressionBasis` of the person has, if there is one. The
best scan is the one after which S is expected to fit the whole library best. A side alone is
proposed where it adds nearly all that both would.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from solver.anatomy.action_units import joined_codes, units_of
from solver.anatomy.template import CORRECTED, ShapeBasis, split_side
from solver.animation.blendshapes import expression_targets
from solver.errors import InputError, SolveError
from solver.fitting import activation
from solver.fitting.activation import ActivationOptions
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.geometry_information import Linearisation, Misfit, Proposal, rank, step_towards
from solver.fitting.information import Posterior
from solver.fitting.objective import SkinDistance, Target
from solver.model import SubjectModel
from solver.surface import Floats

# shapes as ARKit calls them -> words to say to the person in the chair. Looks are missing, as a
# scan of one shows lids alone; and puffed cheeks, which air makes.
WORDS = {
    "browDown": "brows down",
    "browInnerUp": "inner brows up",
    "browOuterUp": "outer brows up",
    "cheekSquint": "cheeks raised",
    "eyeBlink": "eyes closed",
    "eyeSquint": "lids tight",
    "eyeWide": "eyes wide",
    "jawForward": "jaw forward",
    "jawLeft": "jaw to the left",
    "jawOpen": "jaw dropped",
    "jawRight": "jaw to the right",
    "mouthClose": "jaw dropped, lips closed",
    "mouthDimple": "dimples",
    "mouthFrown": "lip corners down",
    "mouthFunnel": "lips funnelled",
    "mouthLeft": "mouth to the left",
    "mouthLowerDown": "lower lip down",
    "mouthPress": "lips pressed",
    "mouthPucker": "lips puckered",
    "mouthRight": "mouth to the right",
    "mouthRollLower": "lower lip sucked in",
    "mouthRollUpper": "upper lip sucked in",
    "mouthShrugLower": "chin raised",
    "mouthShrugUpper": "upper lip pushed up",
    "mouthSmile": "lip corner pull",
    "mouthStretch": "lips stretched",
    "mouthUpperUp": "upper lip raised",
    "noseSneer": "nose wrinkled",
}
NOTHING_NEAR: Mapping[str, Mapping[str, Pose]] = MappingProxyType({})


@dataclass(frozen=True)
class NextScanOptions:
    """Effort of a library's fits, and the gain from which a side alone is enough."""

    iterations: int = 4  # of a fit from rest
    # of one that begins with a basis: its ranks are nearer to those of fits to the end
    iterations_near: int = 2
    one_side: float = 0.9  # of the gain of both


@dataclass(frozen=True)
class Suggestion:
    """An expression to scan: a shape's name without sides, the side if one is enough, its gain."""

    shape: str
    side: str  # ``left``, ``right``, or "" for both or where there are none
    proposal: Proposal

    @property
    def words(self) -> str:
        """Return the instruction to the person."""
        words = WORDS[self.shape]
        return f"{words} on the {self.side}" if self.side else words


def library_targets(model: SubjectModel, basis: ShapeBasis | None) -> dict[str, dict[str, Floats]]:
    """Return shape -> the face's points (k, 3): of ``both``, and of each side where it has two.

    Raises as :func:`solver.animation.blendshapes.expression_targets`, and :class:`InputError`
    (``next_scan.no_shapes``) for a template none of whose shapes has a name of ARKit's.
    """
    neutral = model.skin.vertices[model.face]
    found: dict[str, dict[str, Floats]] = {}
    for name, points in expression_targets(model, basis).items():
        shape, side = split_side(name)
        if shape in WORDS:
            found.setdefault(shape, {})[side or "both"] = points
    for sides in found.values():
        if "both" not in sides:
            sides["both"] = neutral + sum(
                (each - neutral for each in sides.values()), 0.0 * neutral
            )
    if not found:
        message = "the template's expressions have no names that are known here"
        raise InputError("next_scan.no_shapes", message, expected=sorted(WORDS))
    return found


def library_poses(face: Face, own: Face, known: Mapping[str, Floats]) -> dict[str, dict[str, Pose]]:
    """Return shape -> the pose of ``face`` near to it, of ``both`` and of each side.

    ``known`` are expressions' names and the changes (k,) of the controls of ``own`` that make them,
    which is the same person with a jaw of its own. Changes of a shape's sides add up.
    """
    changes: dict[str, dict[str, Floats]] = {}
    for name, change in known.items():
        shape, side = split_side(name)
        whole = change + known.get(CORRECTED.get(name, ""), 0.0)
        changes.setdefault(shape, {})[side or "both"] = whole
    for sides in changes.values():
        if "both" not in sides:
            sides["both"] = np.sum([*sides.values()], axis=0)

    def pose(change: Floats) -> Pose:
        there = own.rest_pose().add(change)
        return face.pose_of(there.a, own.five_jaw_numbers(there.b))

    return {
        shape: {side: pose(change) for side, change in sides.items()}
        for shape, sides in changes.items()
        if shape in WORDS
    }


class Library:
    """The template's expressions on one face: their misfits, fitted and linearised in turn.

    ``scanned`` are the matrices I of what has been scanned. ``near`` are poses that the fits begin
    with, as :func:`library_poses` returns them; others begin at rest.
    """

    def __init__(
        self,
        linearisation: Linearisation,
        scanned: Sequence[Floats],
        targets: Mapping[str, Mapping[str, Floats]],
        options: NextScanOptions = NextScanOptions(),
        listen: Callable[[str, int], None] | None = None,
        near: Mapping[str, Mapping[str, Pose]] = NOTHING_NEAR,
    ) -> None:
        self._linearisation = linearisation
        self._targets = targets
        self._options = options
        self._near = near
        face = linearisation.face
        self._regulariser = activation.unseen_regulariser(face)
        self._curvature = activation.rest_curvature(face)
        self._reached = linearisation.posterior(scanned, linearisation.options.step_sd)
        self.misfits: dict[str, Misfit] = {}
        self.failed: list[str] = []
        for number, name in enumerate(targets):
            if listen:
                listen(name, number)
            misfit = self._of(name, "both")
            if misfit is None:
                self.failed.append(name)
            else:
                self.misfits[name] = misfit
        if not self.misfits:
            raise SolveError("fit.failed", "no expression of the template could be fitted")

    def rank(self) -> list[Proposal]:
        """Return all by their expected gain, best first."""
        return rank(self._linearisation, self._reached, self.misfits)

    def suggest(self, count: int) -> list[Suggestion]:
        """Return up to ``count`` expressions to scan in turn, each the best after those before."""
        found: list[Suggestion] = []
        done: set[str] = set()
        reached = self._reached
        misfits = self.misfits
        theta = np.zeros(len(reached.covariance))
        while len(found) < min(count, len(misfits)):
            ranked = rank(self._linearisation, reached, misfits)
            best = next(each for each in ranked if each.name not in done)
            found.append(Suggestion(best.name, self._side(reached, theta, misfits, best), best))
            done.add(best.name)
            step = step_towards(reached, misfits[best.name])
            reached = reached.after(misfits[best.name].information)
            theta = theta + step
            misfits = {name: misfit.after(step) for name, misfit in misfits.items()}
        return found

    def _side(
        self, reached: Posterior, theta: Floats, misfits: Mapping[str, Misfit], proposal: Proposal
    ) -> str:
        """Return the side that adds nearly as much as both, S being ``theta`` off the known one."""
        enough = self._options.one_side * proposal.gain_mm
        for side in self._targets[proposal.name]:
            misfit = None if side == "both" else self._of(proposal.name, side)
            if misfit is None:
                continue
            step = step_towards(reached, misfit.after(theta))
            after = self._linearisation.error_mm(misfits.values(), step)
            if proposal.before_mm - after >= enough:
                return side
        return ""

    def _of(self, name: str, side: str) -> Misfit | None:
        """Return the misfit of a shape's ``side``, or ``both``; None where nothing fits it."""
        points = self._targets[name][side]
        try:
            return self._linearisation.misfit(self._fit(name, side, points), points)
        except SolveError:
            return None

    def _fit(self, name: str, side: str, points: Floats) -> PosedFace:
        face = self._linearisation.face
        start = None
        if (pose := self._near.get(name, {}).get(side)) is not None:
            with suppress(SolveError):
                start = face.continuation(face.rest, pose)
        options = self._options
        return activation.descend(
            face,
            SkinDistance(face, Target.from_points(points)),
            self._regulariser,
            start or face.rest,
            ActivationOptions(options.iterations_near if start else options.iterations),
            go=Face.newton_predict,
            matrix=self._curvature,
        ).state


def suggestion_words(suggestions: list[Suggestion]) -> str:
    """Return what to do now in one line."""
    return f"Shoot next: {', then '.join(each.words for each in suggestions)}"


def suggestion_figures(suggestion: Suggestion) -> dict[str, Any]:
    """Return a suggestion as plain JSON values."""
    return {
        "shape": suggestion.shape,
        "side": suggestion.side or None,
        "facs": joined_codes(units_of(suggestion.shape)) or None,
        "words": suggestion.words,
        "expected_mm": round(suggestion.proposal.after_mm, 4),
        "gain_mm": round(suggestion.proposal.gain_mm, 4),
    }
