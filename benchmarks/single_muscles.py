"""Muscles of one side pulled alone: where the skin goes, and where it is folded.

They are pulled by the S of a ``--rig`` or else the geometric one, the jaw at rest. The parts, of
which ``--parts`` names some:

``compartments``: each compartment (with ``--whole`` each muscle) is contracted by 30 % along its
    fibres, its volume kept. ``pull_mm`` is how far the skin over the insertion goes along the
    fibres to the origin: below 0 the muscle pushes; ``pulling`` is the part of the muscles that do
    not. ``insertion_mm`` and ``origin_mm`` are how far the flesh of either end comes to the other
    one, and ``held_mm`` how far the origin is from what is held. A ring has none of them.
    ``fibres`` is the length that they reach, by that at rest. ``--pictures`` draws the sheet.
``named``: all of each muscle that anatomy texts name contracts as far as the page's sliders let it,
    within what muscles can do. ``max_mm`` is how far the skin goes, ``as_texts`` whether a place of
    the face goes the way that texts say (:mod:`benchmarks.muscle_actions`), or the part of the
    muscles of which it does. ``lids`` has the gap that the palpebral part leaves between the lids,
    at rest, and where the template closes the eye.
``sliders``: ``left`` is the part of an expression's motion that the sliders of the rig's muscles
    and jaw leave: what the page calls the rest of the expression.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks import documents, report, subjects
from benchmarks.documents import Figures, Plot, Section, Table
from benchmarks.muscle_actions import (
    find_place,
    goes_as_said,
    has_lids,
    lid_gap,
    muscle_actions,
    named_muscles,
)
from benchmarks.muscle_sheet import Pulled, draw, least_stretches
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.animation.blendshapes import keep_within
from solver.drawing.head import muscle_side
from solver.errors import SolveError
from solver.fitting.contraction import Contraction
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face, Pose
from solver.fitting.stretches import fibre_tensors, isochoric_activation
from solver.model import SubjectModel
from solver.rig import ExpressionFit, Rig
from solver.rig.preview.patterns import contract_in_full
from solver.rig.preview.sliders import SliderOptions, controls_of
from solver.surface import Floats, Ints

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PullOptions:
    """Pull of single muscles, and limits of what counts as moved."""

    stretch: float = 0.7  # of the fibres
    least_share: float = 0.2  # of a tet, from which its fibres count
    end: float = 0.3  # part of a muscle, along its fibres, that is its origin or insertion
    over_mm: float = 12.0  # from there to the skin that is over it
    parallel: float = 0.6  # mean of d d^T along its axis, from which fibres have one direction
    places: int = 2  # regions that are named


@dataclass(frozen=True)
class FullOptions:
    """Full contraction of a muscle, and the muscles that close the eyes."""

    sliders: SliderOptions = field(default_factory=SliderOptions)
    within: Admissible = field(default_factory=Admissible)
    lids: str = "palpebral part of orbicularis oculi"
    blink: str = "eyeBlinkLeft"  # the template's expression, in which the lids meet


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    parser.add_argument("--rig", type=Path, help="rig.npz of the subject, whose S is taken")
    report.add_list(parser, "--parts", PARTS)
    parser.add_argument("--pictures", type=Path, help="folder for the sheet")
    parser.add_argument("--muscles", help="names joined by commas; else all of left and middle")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of one subject, and draw its sheet."""
    fits: Sequence[ExpressionFit] = ()
    if options.rig is not None:
        rig = Rig.load(options.rig)
        face = Face(rig.model, rig.weights)
        fits = rig.expressions
    else:
        face = Face(subjects.load(options, COARSE_EDGE_MM if options.quick else EDGE_MM)[0])
    figures: Figures = {
        "subject": _subject(options),
        "S": "geometric" if options.rig is None else "fitted",
        "tets": len(face.model.tets),
    }
    for part in options.parts:
        figures |= PARTS[part](face, fits, options)
    return figures


def _subject(options: argparse.Namespace) -> str:
    return "built-in" if options.faces is None else str(options.subject)


def _compartments(face: Face, _: Sequence[ExpressionFit], options: argparse.Namespace) -> Figures:
    """Return the figures of every compartment, and draw the sheet."""
    wanted = options.muscles.split(",") if options.muscles else None
    found, failed = _sorted_out(pull_each(face, wanted))
    if options.pictures is not None:
        name = _subject(options)
        geometry = "geometric" if options.rig is None else "fitted"
        person = "the built-in person" if name == "built-in" else f"subject {name}"
        title = f"Single muscles of {person}, {geometry} S"
        draw(options.pictures / picture(name), title, face.model, found)
    figures = {muscle: measure(face, muscle, pulled) for muscle, pulled in found.items()}
    pulls = [each["pull_mm"] for each in figures.values() if each["pull_mm"] is not None]
    return {
        "pulling": report.part_true([pull > 0.0 for pull in pulls]),
        "with_ends": len(pulls),
        "muscles": figures,
        "failed": failed,
    }


def _sorted_out(
    pulled: Iterator[tuple[str, Pulled | SolveError]],
) -> tuple[dict[str, Pulled], dict[str, str]]:
    """Return muscle -> skin, and muscle -> why there is none."""
    found = {}
    failed = {}
    for muscle, state in pulled:
        if isinstance(state, SolveError):
            failed[muscle] = f"{state.code}: {state.message}"
        else:
            found[muscle] = state
        log.info("%s %s", muscle, failed.get(muscle, ""))
    return found, failed


def _named(face: Face, fits: Sequence[ExpressionFit], _: argparse.Namespace) -> Figures:
    found, failed = _sorted_out(pull_named(face, fits))
    return {**named_figures(face.model, found), "named_failed": failed}


def pull_named(
    face: Face, fits: Sequence[ExpressionFit] = (), options: FullOptions = FullOptions()
) -> Iterator[tuple[str, Pulled | SolveError]]:
    """Yield every muscle of the table of actions as :func:`pull_each`, as its sliders at 1."""
    model = face.model
    rest = face.rest
    before = face.whole_skin(rest.x, rest.pose.b)
    limits = options.within.feasible(model, face.flesh.volumes, face.S)
    fitted = [fit.activations for fit in fits]
    pulled = contract_in_full(Contraction(limits.tensors), fitted, options.sliders.full_stretch)
    done: set[str] = set()
    for action in muscle_actions():
        numbers = named_muscles(model, action.muscle, both=action.is_ring)
        numbers = numbers[np.isfinite(limits.tensors[numbers]).all(axis=(1, 2))]
        if not len(numbers) or action.muscle in done:
            continue
        done.add(action.muscle)
        a = rest.pose.a.copy()
        a[numbers] = pulled[numbers]
        pose = Pose(keep_within(a, limits)[0], rest.pose.b)
        try:
            x = face.continuation(rest, pose).x
        except SolveError as error:
            yield action.muscle, error
        else:
            yield action.muscle, Pulled(before, face.whole_skin(x, pose.b), x)


def named_figures(
    model: SubjectModel, pulled: dict[str, Pulled], options: FullOptions = FullOptions()
) -> Figures:
    """Return what muscles of anatomy texts do in full, and whether that is what texts say."""
    figures: Figures = {}
    for action in muscle_actions():
        place = find_place(model, action.place)
        if action.muscle in pulled and len(place):
            motion = pulled[action.muscle].motion
            size = np.linalg.norm(motion[model.face], axis=1)
            figures[action.muscle] = {
                "max_mm": float(size.max()),
                **goes_as_said(action, motion[place]),
            }
    found: Figures = {
        "as_texts": report.part_true([each["as_texts"] for each in figures.values()]),
        "named": figures,
    }
    if options.lids in pulled and has_lids(model):
        found["lids"] = _lids(model, pulled[options.lids], options)
    return found


def _lids(model: SubjectModel, pulled: Pulled, options: FullOptions) -> Figures:
    """Return the gap of the left lids, mm: ``gap_mm`` beyond that where the template blinks.

    Lids that meet may have one by their thickness.
    """
    known = model.expressions
    closed = 0.0
    if known is not None and options.blink in known.names:
        skin = model.skin.vertices.copy()
        skin[model.face] += known.motions[known.names.index(options.blink)]
        closed = lid_gap(model, skin)
    left = lid_gap(model, pulled.after)
    return {
        "gap_mm": max(left - closed, 0.0),
        "at_rest_mm": lid_gap(model, pulled.before) - closed,
        "closed_mm": closed,
    }


def _sliders(face: Face, fits: Sequence[ExpressionFit], _: argparse.Namespace) -> Figures:
    left = left_by_sliders(face, fits)
    return {"left": left, "left_most": max(left.values(), default=None)}


def left_by_sliders(face: Face, fits: Sequence[ExpressionFit]) -> dict[str, float]:
    """Return expression -> the part of its motion that sliders of muscles and jaw leave.

    That is by the root mean square over the face. Expressions are left out that the sliders do not
    come to rest in.
    """
    if not fits:
        return {}
    sliders = controls_of(face, fits)
    rest = face.rest
    found = {}
    own = sliders.of_kind("muscle") + sliders.of_kind("jaw")
    ids = face.model.face
    for fit in fits:
        values = np.zeros(len(sliders))
        values[own] = sliders.presets[fit.name][own]
        try:
            x = face.continuation(rest, sliders.pose(values)).x
        except SolveError as error:
            log.warning("%s: %s", fit.name, error)
            continue
        motion = fit.skin[ids] - face.model.skin.vertices[ids]
        left = fit.skin[ids] - face.face_points(x)
        found[fit.name] = float(np.linalg.norm(left) / np.linalg.norm(motion))
    return found


PARTS: dict[str, Callable[[Face, Sequence[ExpressionFit], argparse.Namespace], Figures]] = {
    "compartments": _compartments,
    "named": _named,
    "sliders": _sliders,
}


def picture(subject: str) -> str:
    """Return the file name of a subject's sheet."""
    return f"single_muscles-{subject}.png"


def pull_each(
    face: Face, wanted: list[str] | None = None, options: PullOptions = PullOptions()
) -> Iterator[tuple[str, Pulled | SolveError]]:
    """Yield every muscle with the skin when it is pulled, or with why there is none.

    They are those of the left and the middle that have fibres in S, unless others are ``wanted``.
    """
    model = face.model
    rest = face.rest
    before = face.whole_skin(rest.x, rest.pose.b)
    tensors = fibre_tensors(model, face.flesh.volumes, face.S)
    for number, muscle in enumerate(model.muscle_names):
        is_wanted = muscle in wanted if wanted else muscle_side(muscle) != "right"
        if not is_wanted or not np.isfinite(tensors[number]).all():
            continue
        pose = Pose(rest.pose.a.copy(), rest.pose.b)
        pose.a[number] = isochoric_activation(tensors[number], options.stretch)
        try:
            x = face.continuation(rest, pose).x
        except SolveError as error:
            yield muscle, error
        else:
            yield muscle, Pulled(before, face.whole_skin(x, pose.b), x)


def measure(
    face: Face, muscle: str, pulled: Pulled, options: PullOptions = PullOptions()
) -> Figures:
    """Return what a muscle does to the skin; lengths in mm, fractions of lengths at rest."""
    model = face.model
    tets, directions = _fibres(face, muscle, options.least_share)
    motion = pulled.motion[model.face]
    size = np.linalg.norm(motion, axis=1)
    skin = model.skin.vertices[model.face]
    lengths = np.linalg.norm(_carried(model.rest, pulled.x, model.tets[tets], directions), axis=1)
    stretch, _ = least_stretches(model, pulled)
    middle = skin[size.argmax()]
    lateral, up, forward = motion[size.argmax()] * [np.sign(middle[0]) or 1.0, 1.0, 1.0]
    return {
        "max_mm": float(size.max()),
        "lateral_mm": float(lateral),
        "up_mm": float(up),
        "forward_mm": float(forward),
        "regions": _regions(model.regions, pulled.motion, options.places),
        **_ends(face, tets, directions, pulled, options),
        "fibres": float(np.average(lengths, weights=face.flesh.volumes[tets])),
        "skin_shortest": float(np.min(stretch, where=np.isfinite(stretch), initial=1.0)),
    }


def _fibres(face: Face, muscle: str, least_share: float) -> tuple[Ints, Floats]:
    """Return the tets that are a muscle's for the most part, and its fibres' directions in them."""
    model = face.model
    S = face.S
    column = model.muscle_number(muscle) + 1
    assert model.fibres is not None, "a muscle that is pulled has fibres"
    entries = np.flatnonzero(S.indices == column)
    share = S.data[entries]
    kept = entries[share > min(least_share, 0.5 * share.max())]
    tets = np.searchsorted(S.indptr, kept, side="right") - 1
    return tets, np.asarray(model.fibres[kept])


def _ends(
    face: Face, tets: Ints, directions: Floats, pulled: Pulled, options: PullOptions = PullOptions()
) -> Figures:
    """Return what the ends of a muscle do, by its tets and their fibres from the origin on.

    None for a ring, and for the skin where there is none over the insertion.
    """
    keys = ("pull_mm", "insertion_mm", "origin_mm", "held_mm")
    values, axes = np.linalg.eigh(directions.T @ directions / len(directions))
    if values[2] < options.parallel:
        return dict.fromkeys(keys)
    model = face.model
    axis = axes[:, 2] * np.sign(axes[:, 2] @ directions.sum(axis=0))
    corners = model.rest[model.tets[tets]]
    middles = corners.mean(axis=1)
    gone = (pulled.x[model.tets[tets]] - corners).mean(axis=1)
    along = middles @ axis
    origin = along <= np.quantile(along, options.end)
    insertion = along >= np.quantile(along, 1.0 - options.end)
    skin = model.skin.vertices[model.face]
    motion = pulled.motion[model.face]
    over, nearest = cKDTree(middles[insertion]).query(skin)
    near = over < options.over_mm
    to_origin = -directions[insertion][nearest[near]]
    pulls = np.einsum("ij,ij->i", motion[near], to_origin)
    held = model.rest[np.concatenate([model.cranium, model.mandible, model.cut])]
    found = (
        pulls.mean() if near.any() else None,
        -(gone[insertion] @ axis).mean(),
        (gone[origin] @ axis).mean(),
        cKDTree(held).query(middles[origin])[0].mean(),
    )
    return {
        key: None if each is None else float(each) for key, each in zip(keys, found, strict=True)
    }


def _carried(rest: Floats, x: Floats, tets: Ints, directions: Floats) -> Floats:
    """Return F d (n, 3) of directions d in tets (n, 4)."""
    before, after = (points[tets[:, 1:]] - points[tets[:, :1]] for points in (rest, x))
    weights = np.linalg.solve(before.transpose(0, 2, 1), directions[..., None])
    return np.asarray((after.transpose(0, 2, 1) @ weights)[..., 0])


def _regions(regions: dict[str, Ints], motion: Floats, count: int) -> list[str]:
    """Return the regions of the skin that move most."""
    size = np.linalg.norm(motion, axis=1)
    means = {name: float(size[ids].mean()) for name, ids in regions.items() if len(ids)}
    return sorted(means, key=lambda name: -means[name])[:count]


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    columns = {
        "max_mm": "greatest, mm",
        "lateral_mm": "lateral",
        "up_mm": "up",
        "forward_mm": "forward",
        "pull_mm": "skin pulled, mm",
        "insertion_mm": "insertion, mm",
        "origin_mm": "origin, mm",
        "held_mm": "from held, mm",
        "fibres": "fibres",
        "skin_shortest": "shortest skin",
    }
    rows = [
        [muscle, *(found[key] for key in columns), ", ".join(found["regions"])]
        for muscle, found in figures.get("muscles", {}).items()
    ]
    sheet = documents.IMAGES / picture(figures["subject"])
    parts: list[Table | Plot | str] = []
    if sheet.exists():
        parts.append(Plot(sheet, "Every muscle of the left side alone"))
    if "named" in figures:
        parts += [_named_words(figures), _named_table(figures)]
    if figures.get("left"):
        left = [[name, 100.0 * part] for name, part in figures["left"].items()]
        parts.append(Table(["expression", "motion that its sliders leave, %"], left))
    if rows:
        parts.append(Table(["muscle", *columns.values(), "regions"], rows))
    return Section(
        title="Single muscles",
        compared="Every muscle of the left side and the middle contracted alone by 30 %, by the "
        f"{figures['S']} S: how far the skin goes, and where to at the place that goes farthest, "
        "in mm; how far it is pulled over the insertion along the fibres to the origin; how far "
        "the flesh of the insertion and of the origin comes to the other end, and how far from "
        "what is held the origin lies (no figures: a ring); how short fibres and skin become. "
        "All of a muscle that anatomy texts name as far as the page's sliders let it: how far the "
        "skin goes, and where the place goes to that texts tell of.",
        parts=parts,
    )


def _named_words(figures: Figures) -> str:
    """Return in a sentence how many muscles do what texts say, and whether eyes close."""
    words = f"{100.0 * figures['as_texts']:.0f} % of the muscles do to the skin what texts say."
    if lids := figures.get("lids"):
        left = lids["gap_mm"]
        whole = lids["at_rest_mm"]
        words += f" The palpebral part leaves {left:.1f} of the {whole:.1f} mm between the lids."
    return words


def _named_table(figures: Figures) -> Table:
    keys = ("max_mm", "place", "lateral_mm", "up_mm", "forward_mm")
    rows = [
        [muscle, *(each[key] for key in keys), " and ".join(each["ways"]), each["as_texts"]]
        for muscle, each in figures["named"].items()
    ]
    heads = ["muscle", "greatest, mm", "place", "lateral", "up", "forward", "by texts", "so"]
    return Table(heads, rows)


if __name__ == "__main__":
    main()
