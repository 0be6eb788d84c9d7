"""Neutrals that are none, by what every expression asks for: a smile as rest, parted teeth.

A fit counts from the neutral. Was it scanned with a smile, then the muscles that smile lengthen
wherever the person does not smile more; was it scanned with parted teeth, then the jaw closes
beyond rest wherever the mouth is shut. One expression says nothing of that, most of them together
do. Only neutrals of the whole topology show their teeth, so that these are looked at, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.action_units import action_units
from solver.errors import Finding, make_warning
from solver.fitting.face import Face
from solver.mechanics.boundary import FreeJaw
from solver.model import SubjectModel
from solver.rig.report.certificate import jaw_motion, muscles
from solver.rig.report.prime_movers import is_one_of
from solver.rig.rig import ExpressionFit


@dataclass(frozen=True)
class NeutralLimits:
    """Bounds of what a neutral may ask of expressions."""

    least: int = 5  # expressions that are known, to judge by
    most: float = 0.6  # part of them from which they speak for the neutral
    unit: str = "AU 12"  # that a neutral may have: the corners of the mouth drawn up
    lengthened: float = 0.02  # of the unit's muscles, both sides together
    contracted: float = 0.05  # from which an expression has the unit
    closed_mm: float = 3.0  # that the jaw closes beyond rest
    apart_mm: float = 1.5  # between the rows of teeth; less is the freeway space of a relaxed jaw


def check_neutral(
    face: Face, fits: Sequence[ExpressionFit], options: NeutralLimits = NeutralLimits()
) -> list[Finding]:
    """Return what expressions fitted by ``face``, with its S, say against the neutral."""
    fits = [fit for fit in fits if fit.status != "failed"]
    known = len(fits) >= options.least
    parted = _find_parted_teeth(face.model, options)
    if known and not parted:
        parted = _find_closing_jaw(face.model, fits, options)
    return [*parted, *(_find_smile(face, fits, options) if known else [])]


def _find_parted_teeth(model: SubjectModel, options: NeutralLimits) -> list[Finding]:
    """Find rows of teeth that are apart in the neutral."""
    rows = [model.region(f"{name}_teeth") for name in ("upper", "lower")]
    upper, lower = (model.skin.vertices[row] for row in rows)
    if not (len(upper) and len(lower)):
        return []
    apart = float(cKDTree(upper).query(lower)[0].min())
    if apart <= options.apart_mm:
        return []
    message = f"the neutral's teeth are {apart:.1f} mm apart"
    return [_report_parted(message, apart)]


def _find_closing_jaw(
    model: SubjectModel, fits: Sequence[ExpressionFit], options: NeutralLimits
) -> list[Finding]:
    """Find a jaw that closes beyond rest in most expressions."""
    closings = {
        fit.name: -jaw_motion(model, FreeJaw(model.jaw).matrix(fit.jaw)).opening_mm for fit in fits
    }
    names = [name for name, closing in closings.items() if closing > options.closed_mm]
    if len(names) < options.most * len(fits):
        return []
    typical = float(np.median([closings[name] for name in names]))
    message = f"the jaw closes {typical:.1f} mm beyond the neutral in {', '.join(names)}"
    return [_report_parted(message, typical)]


def _report_parted(message: str, mm: float) -> Finding:
    advice = "it was scanned with parted teeth: scan a neutral with closed ones"
    return make_warning("neutral.parted_teeth", f"{message}: {advice}", {"mm": round(mm, 1)})


def _find_smile(face: Face, fits: Sequence[ExpressionFit], options: NeutralLimits) -> list[Finding]:
    """Find a unit whose muscles lengthen in most expressions and contract in none."""
    unit, found, model = action_units()[options.unit], {}, face.model
    of_unit = np.array([is_one_of(whole, unit.muscles) for whole in model.muscle_groups])
    for fit in fits:
        each = muscles(model, face.flesh.volumes, face.S, fit.activations)
        mine = each.contraction[of_unit & each.is_judged & np.isfinite(each.contraction)]
        if not len(mine):
            return []
        found[fit.name] = float(mine.mean())
    names = [name for name, by in found.items() if by <= -options.lengthened]
    if max(found.values()) > options.contracted or len(names) < options.most * len(fits):
        return []
    message = (
        f"{' and '.join(unit.muscles)} lengthen in {', '.join(names)} and contract in no "
        f"expression: the neutral has {unit.code} ({unit.name}), it smiles; scan a relaxed one"
    )
    return [make_warning("neutral.smiles", message, {"expressions": names})]
