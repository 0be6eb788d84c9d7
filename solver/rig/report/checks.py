"""The checks of a rig: their limits, what to do beyond them, and the verdict on a rig.

Limits are the project's own, from what fits of captured faces reach, unless a source is named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from solver.errors import Verdict
from solver.fitting.contraction import STILL
from solver.mechanics.newton import NewtonOptions
from solver.rig.report.certificate import Certificate, StrayOptions
from solver.rig.report.measures import Measure, measures, measures_of_rig
from solver.rig.report.prime_movers import MoverOptions
from solver.rig.rig import Rig

ALL = "all expressions"  # where a check of the rig as a whole is made
ORDER: tuple[Verdict, ...] = ("good", "usable", "bad")


@dataclass(frozen=True)
class FigureLimits:
    """A figure up to ``good`` is good, up to ``usable`` usable, else bad.

    With ``least`` it is from ``good`` upwards.
    """

    good: float
    usable: float
    unit: str = ""
    least: bool = False

    def sign(self, value: float) -> float:
        """Return the figure with its sign turned where less is worse."""
        return -value if self.least else value

    def verdict(self, value: float) -> Verdict:
        """Judge a figure; what is not a number is bad."""
        if self.sign(value) <= self.sign(self.good):
            return "good"
        return "usable" if self.sign(value) <= self.sign(self.usable) else "bad"


GROUPS = {  # first part of a check's code -> words
    "skin": "Skin",
    "flesh": "Flesh",
    "muscles": "Muscles and jaw",
    "jaw": "Muscles and jaw",
    "contact": "Contact",
    "trip": "Round trip",
    "solver": "Solver",
}


@dataclass(frozen=True)
class RigCheck:
    """A figure with its limits; ``meaning`` and ``advice`` are for the person who reads the page.

    ``{longer}`` in an advice is the option that lets the fit go on.
    """

    code: str
    title: str
    limits: FigureLimits
    meaning: str
    advice: str

    @property
    def group(self) -> str:
        """Return the words of the checks that it stands with."""
        return GROUPS[self.code.split(".")[0]]

    def advise(self, settings: Mapping[str, Any]) -> str:
        """Return the advice to somebody whose job had these ``settings``."""
        longer = "more iterations"
        for option in ("rounds", "max_iterations"):
            if option in settings:
                longer = f"{option} {2 * settings[option]} instead of {settings[option]}"
        return self.advice.format(longer=longer)


CHECKS = (
    RigCheck(
        "skin.mean",
        "Mean distance",
        FigureLimits(0.45, 1.0, "mm"),
        "between scan and fit, over the part of the face that the scan shows",
        "Look at the expression's picture. If the error is all over the face, the scan is not "
        "registered to this neutral: register it again. If it is in one place, look there.",
    ),
    RigCheck(
        "skin.p95",
        "Distance of the worst twentieth",
        FigureLimits(1.3, 2.5, "mm"),
        "19 of 20 vertices of the face are nearer to the scan than this",
        "Look at the red patches in the picture: hair, a shadow or a hole in the scan shows as a "
        "patch with a sharp rim. Mask it or scan again.",
    ),
    RigCheck(
        "skin.region",
        "Mean distance in the worst region",
        FigureLimits(1.0, 2.0, "mm"),
        "the region of the face that fits worst",
        "Run fit_geometry again with one more scan, of an expression that moves this region.",
    ),
    RigCheck(
        "skin.coverage",
        "Face that the scan shows",
        FigureLimits(95.0, 60.0, "%", least=True),
        "share of the face's vertices with confidence in the scan",
        "The rest of the face follows the muscles and is not measured. Scan again if it matters.",
    ),
    RigCheck(
        "flesh.inverted",
        "Inverted tets",
        FigureLimits(0, 0),
        "tets that are turned inside out",
        "Do not simulate with this expression. Fit it again with {longer}.",
    ),
    RigCheck(
        "flesh.flattest",
        "Flattest tet",
        FigureLimits(0.05, 0.005, "of its volume", least=True),
        "the smallest volume of a tet by its volume at rest",
        "The skin may be used. A simulation that starts here takes small steps; if it fails, run "
        "build_model with edge_mm 16 instead of 9 and fit again: the flattest tet then keeps "
        "about ten times as much of its volume.",
    ),
    RigCheck(
        "flesh.volume",
        "Change of volume",
        FigureLimits(5.0, 10.0, "%"),
        "of the flesh as a whole; living flesh keeps its volume",
        "The skin is not touched by this. Do not take masses or volumes from this expression.",
    ),
    RigCheck(
        "flesh.residual",
        "Residual force",
        FigureLimits(10 * NewtonOptions.tolerance, NewtonOptions.stalled),
        "what is left of the forces, by the forces at unit strain",
        "The flesh has not come to rest. Fit this expression again with {longer}.",
    ),
    RigCheck(
        "flesh.minimum",
        "Unstable equilibrium",
        FigureLimits(0, 0),
        "1 if the flesh could snap into another shape",
        "The skin may be used. Simulations may snap away from this shape: leave it out of them.",
    ),
    RigCheck(
        "muscles.inside_out",
        "Muscles turned inside out",
        FigureLimits(0, 0),
        "muscles whose activation has no physical shape",
        "The skin is right, the muscles are not: play the expression back, but do not edit its "
        "activations. A training scan that moves these muscles differently helps.",
    ),
    RigCheck(
        "muscles.beyond",
        "Muscles beyond what muscles can do",
        FigureLimits(0, np.inf),
        "shrinking below half, growing beyond double, pushing, or losing volume",
        "The expression may be played back and blended. Do not read these activations as effort: "
        "fit S and activations again with controls admissible, which keeps muscles to what they "
        "can do.",
    ),
    RigCheck(
        "muscles.movers",
        "Muscles that contradict the expression",
        FigureLimits(0, np.inf),
        "by the action units of its name, as FACS and anatomy texts have their muscles",
        "The skin is right, by other muscles than a living face takes for it: do not read these "
        "activations as effort.",
    ),
    RigCheck(
        "muscles.idle",
        "Muscles of the expression that hold still",
        FigureLimits(0, np.inf),
        f"that its name calls for, and that contract by less than {100 * STILL.least:g} %",
        "The skin is right, by other muscles than a living face takes for it, or the person made "
        "it otherwise than the name says: look at the picture, give the capture the name of what "
        "it shows, and do not read its activations as effort.",
    ),
    RigCheck(
        "muscles.sides",
        "Left against right",
        FigureLimits(100.0 * MoverOptions.uneven, np.inf, "%"),
        "how much more a muscle contracts than that of the other side, where the scan moves alike "
        "on both",
        "The scan gives no reason for it: read the mean of both sides. A fit_geometry with a "
        "greater weight of symmetry keeps S alike on both.",
    ),
    RigCheck(
        "muscles.strayed",
        "Flesh outside its muscle",
        FigureLimits(100.0 * StrayOptions.most, np.inf, "%"),
        f"part of a muscle in S that is more than {StrayOptions.beyond_mm:g} mm outside the "
        "surface which the anatomy gives it",
        "The skin is right, but flesh pulls there that is none of this muscle's: do not read its "
        "activations as effort, and look at what edits of it do.",
    ),
    RigCheck(
        "jaw.range",
        "Jaw beyond what jaws can do",
        FigureLimits(0, np.inf),
        "figures of its motion that are outside the range of adults' jaws",
        "Check the neutral scan: with parted or clenched teeth there, every jaw angle is off.",
    ),
    RigCheck(
        "contact.lips",
        "Lips in each other",
        FigureLimits(0.5, 3.0, "mm"),
        "greatest depth of a lip in the other one",
        "A fit follows its scan: correct the scan if its lips cross by as much, else fit it again "
        "with {longer}.",
    ),
    RigCheck(
        "contact.teeth",
        "Lips in teeth",
        FigureLimits(0.5, 3.0, "mm"),
        "greatest depth of a lip in the teeth",
        "Seen from the side, teeth may show through a lip. Sculpt it, or leave the expression out.",
    ),
    RigCheck(
        "contact.bite",
        "Teeth in teeth",
        FigureLimits(1.0, 3.0, "mm"),
        "greatest depth of lower teeth in upper ones",
        "The jaw closes too far or goes back too far: see its motion.",
    ),
    RigCheck(
        "trip.skin",
        "Simulated from rest",
        FigureLimits(0.05, 0.3, "mm"),
        "mean distance between the fitted skin and the one simulated from its activations",
        "The skin may be used. This pose has two shapes of rest: blend into it from a "
        "neighbouring expression instead of from rest.",
    ),
    RigCheck(
        "trip.snap",
        "Simulated from rest, greatest",
        FigureLimits(0.5, 2.0, "mm"),
        "where the fitted and the simulated skin are furthest apart",
        "A patch of skin snaps into another shape. Look there in the picture; blend into this "
        "pose from a neighbouring expression.",
    ),
    RigCheck(
        "trip.refit",
        "Fitted again",
        FigureLimits(0.05, 0.3, "mm"),
        "mean distance between the simulated skin and a new fit to it",
        "The solver stops before the minimum: fit with {longer}.",
    ),
    RigCheck(
        "trip.activations",
        "Activations found again",
        FigureLimits(10.0, 30.0, "%"),
        "difference of the excited muscles' activations by their distance from rest",
        "Other activations give the same skin: do not compare single muscles between expressions.",
    ),
    RigCheck(
        "solver.failed",
        "Fits that broke down",
        FigureLimits(0, 0),
        "the best state on the way was kept",
        "Do not use this expression. Mend what its warnings say of its scan, and fit it again.",
    ),
    RigCheck(
        "solver.stopped",
        "Fits that ended early",
        FigureLimits(0, np.inf),
        "stopped before the minimum",
        "If the picture shows errors, fit this expression again with {longer}.",
    ),
    RigCheck(
        "solver.warnings",
        "Warnings",
        FigureLimits(0, np.inf),
        "what the solver noticed about scan, model or solve",
        "Each stands with its expression, under Warnings; docs/reference/errors.md says of its "
        "code what to do.",
    ),
)


EFFORT = "not to be read as effort"
# A check's code, or its beginning -> what a rig that fails it is not good for, but animation is
SPOILED = {
    "muscles": f"single muscles are {EFFORT}",
    "trip.activations": f"single muscles are {EFFORT}",
    "jaw": "the jaw's angles are not to be measured",
    "flesh.volume": "masses and volumes are not to be taken from it",
    "flesh.flattest": "simulations are not to start from every expression",
    "flesh.minimum": "simulations are not to start from every expression",
    "trip.skin": "some poses are to be blended into from others, not from rest",
    "trip.snap": "some poses are to be blended into from others, not from rest",
}


def overall(verdicts: list[Verdict]) -> Verdict:
    """Return the worst of the verdicts; good without any."""
    return max(verdicts, key=ORDER.index, default="good")


@dataclass(frozen=True)
class Judgement:
    """A check over all expressions that it could be made for; ``worst`` names one of them."""

    check: RigCheck
    worst: str
    measures: dict[str, Measure]

    @property
    def verdict(self) -> Verdict:
        """Return the verdict on the worst expression."""
        return self.of(self.worst)

    def of(self, expression: str) -> Verdict:
        """Return the verdict on an expression."""
        return self.check.limits.verdict(self.measures[expression].value)

    @property
    def spoils(self) -> str:
        """Return in words what a rig that fails the check is not good for; "" is animation."""
        found = (words for start, words in SPOILED.items() if self.check.code.startswith(start))
        return next(found, "")


def expression_verdict(judgements: Sequence[Judgement], expression: str) -> Verdict:
    """Return the worst verdict of the checks that were made of an expression."""
    return overall([each.of(expression) for each in judgements if expression in each.measures])


@dataclass(frozen=True)
class Limit:
    """Something that a rig is not good for, and the worst reason: a check in an expression."""

    words: str
    code: str
    expression: str


def limits_of(judgements: Sequence[Judgement]) -> list[Limit]:
    """Return what a rig is not good for besides animation, each with its worst reason."""
    spoiling: dict[str, list[Judgement]] = {}
    for each in judgements:
        if each.verdict != "good" and each.spoils:
            spoiling.setdefault(each.spoils, []).append(each)
    return [_limit(spoiled, failed) for spoiled, failed in spoiling.items()]


def _limit(spoiled: str, failed: Sequence[Judgement]) -> Limit:
    """Return what failed checks spoil, by the worst of them in its worst expression."""
    worst = max(failed, key=lambda each: ORDER.index(each.verdict))
    found = {name: worst.measures[name].worst for name in worst.measures}
    amounts = {
        name: said.amount for name, said in found.items() if said and worst.of(name) != "good"
    }
    expression = max(amounts, key=lambda name: amounts[name], default=worst.worst)
    muscles = [
        (name, muscle)
        for each in failed
        for name, measure in each.measures.items()
        if each.of(name) != "good"
        for muscle in measure.muscles
    ]
    # muscles by their wholes: checks name compartments, or whole muscles
    if count := len({muscle.partition(".")[0] for _, muscle in muscles}):
        spoiled = f"{'one muscle is' if count == 1 else f'{count} muscles are'} {EFFORT}"
    among = "worst in" if len(set(muscles)) > 1 else "in"
    reason = _reason(worst.check, worst.measures[expression])
    return Limit(f"{spoiled} ({among} {expression}: {reason})", worst.check.code, expression)


def _reason(check: RigCheck, found: Measure) -> str:
    """Return the worst that a check found in an expression, in words."""
    if found.worst is not None:
        return str(found.worst)
    if check.code == "jaw.range" or not np.isfinite(found.value):
        return found.detail
    figure = f" {found.value:.3g} {check.limits.unit}" if check.limits.unit else ""
    return f"{check.title[0].lower()}{check.title[1:]}{figure}"


def use(judgements: Sequence[Judgement], expressions: Sequence[str]) -> str:
    """Say what a rig is good for, and what not, as :func:`ready` and :func:`limits_of`."""
    words = [ready(judgements, expressions), *(each.words for each in limits_of(judgements))]
    return f"{'; '.join(words)}."


def ready(judgements: Sequence[Judgement], expressions: Sequence[str]) -> str:
    """Say whether a rig is ready for animation, and which expressions are not."""
    failed = [each for each in judgements if each.verdict != "good"]
    if not failed:
        return "Ready for animation and simulation: all checks are good"
    shown = [each for each in failed if not each.spoils]
    bad = [
        name
        for name in expressions
        if any(name in each.measures and each.of(name) == "bad" for each in shown)
    ]
    if bad and len(bad) == len(expressions):
        return "Not ready for animation, since every expression fails a check"
    is_spoiled = any(each.spoils and each.verdict == "bad" for each in failed)
    words = "To be used for animation alone" if is_spoiled else "Ready for animation"
    if bad:
        words += f"{',' if is_spoiled else ''} without {', '.join(bad)}"
    return words


def judge(rig: Rig, certificate: Certificate) -> list[Judgement]:
    """Judge every check that could be made, in the order of :data:`CHECKS`.

    One of the rig as a whole has a figure of :data:`ALL`, and of no expression.
    """
    made = {
        fit.name: measures(rig, fit, certificate.expressions[fit.name]) for fit in rig.expressions
    }
    made[ALL] = measures_of_rig(rig.model, certificate)
    judgements = []
    for check in CHECKS:
        known = {name: found[check.code] for name, found in made.items() if check.code in found}
        if known:
            bad = {name: check.limits.sign(each.value) for name, each in known.items()}
            worst = max(bad, key=lambda name: np.inf if np.isnan(bad[name]) else bad[name])
            judgements.append(Judgement(check, worst, known))
    return judgements
