"""Whether what scans and markers are said to tell is so: the next scan, and muscles by markers.

``next_scan``: three expressions of the template are drawn, S is fitted to them, and the library is
ranked as by the job ``next_scan``. Then S is fitted again with the expression it proposes, and with
five others drawn at random, and the capture set's expressions, none of which S has seen, are fitted
by activations alone. ``better_than_random`` is the part of the draws in which the proposed one
lowers their mean error more than the median of the five; ``gain_correlation`` is that between
predicted and measured gains over all draws, ``rank_correlation`` that of their ranks within a draw.

``identifiable``: the part of the muscles of which markers tell more than half, by fibre muscles of
90 kPa with activations of prior sd 0.3, and markers of 0.5 mm spread evenly over the face,
linearised at rest; ``greedy`` has each marker where it helps most. Worst subject.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp
import scipy.stats

from benchmarks import report, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.fitting import activation, fallback, geometry
from solver.fitting.controls import JAW_UNITS, Block, Layout, jaw_block
from solver.fitting.face import Face, PosedFace
from solver.fitting.geometry import GeometryOptions
from solver.fitting.geometry_information import InformationOptions, Linearisation
from solver.fitting.information import Posterior
from solver.fitting.objective import SkinDistance, Target, distances
from solver.mechanics.boundary import JAW_FREEDOM, BoundaryRates
from solver.mechanics.fibre_muscle import FibreMuscles, driven_by_muscles
from solver.mechanics.flesh import MOONEY_RIVLIN
from solver.mechanics.response import Response, SparseControls
from solver.model import SubjectModel
from solver.rig.next_scan import Library, library_targets
from solver.surface import Floats, Ints
from solver.templates.builtin.build import builtin_template
from solver.templates.export import CaptureSet
from solver.templates.ict_facekit import read_facekit, shape_basis

SCANS, OTHERS = 3, 5
QUICK_ROUNDS = 6
MARKERS = (79, 40, 17)
STRENGTH = 30.0
"""Of all fibres, by the flesh's mu: 90 kPa in flesh of 3."""

PRIOR_SD, NOISE_MM, KNOWN = 0.3, 0.5, 0.5
"""Of an activation and of a marker; and the information of a muscle that counts as identifiable."""

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_folders(parser)
    parser.add_argument("--subjects", default="A,B,C", metavar="LIST")
    parser.add_argument("--draws", type=int, default=10, help="draws of three scans a subject")
    parser.add_argument("--coarse", action="store_true", help="tets of twice the size")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of all subjects."""
    edge = COARSE_EDGE_MM if options.coarse or options.quick else EDGE_MM
    shapes = builtin_template().shapes
    if options.faces is not None:
        shapes = shape_basis(read_facekit(options.faces))
    people, draws = {}, []
    for name, model, captures in subjects.each(options, options.subjects.split(","), edge):
        face = Face(model)
        people[name] = identifiable(model)
        log.info("%s: %s", name, people[name])
        targets = library_targets(model, shapes)
        goals = {shape: sides["both"] for shape, sides in targets.items()}
        for seed in range(options.draws):
            found = draw(face, goals, captures, np.random.default_rng(seed), options.quick)
            log.info("%s %d: %s", name, seed, found)
            draws.append({"subject": name, "seed": seed, **found})
    return {
        "next_scan": summary(draws),
        "identifiable": {
            key: min(person[key] for person in people.values())
            for key in next(iter(people.values()), {})
        },
        "identifiable_by_subject": people,
        "draws": draws,
    }


def summary(draws: list[Figures]) -> Figures:
    """Return the figures over all draws."""
    if not draws:
        return {}
    pairs = [(each["predicted_mm"], each["measured_mm"]) for each in draws]
    predicted, measured = (np.concatenate(each) for each in zip(*pairs, strict=True))
    ranks = [scipy.stats.spearmanr(*pair).statistic for pair in pairs]
    better = [pair[1][0] > np.median(pair[1][1:]) for pair in pairs]
    return {
        "better_than_random": float(np.mean(better)),
        "gain_correlation": float(np.corrcoef(predicted, measured)[0, 1]),
        "rank_correlation": float(np.mean(ranks)),
        "draws": len(draws),
        "unseen_before_mm": float(np.mean([each["before_mm"] for each in draws])),
        "gain_proposed_mm": float(np.mean([each["measured_mm"][0] for each in draws])),
        "gain_others_mm": float(np.mean([each["measured_mm"][1:] for each in draws])),
    }


def draw(
    face: Face,
    goals: Mapping[str, Floats],
    captures: CaptureSet,
    rng: np.random.Generator,
    quick: bool,
) -> Figures:
    """Return predicted and measured gains, mm, of the proposed expression and of five others."""
    scans = [str(name) for name in rng.choice(list(goals), SCANS, replace=False)]
    unseen = {
        name: scan.vertices[face.model.face]
        for name, scan in {**captures.train, **captures.test}.items()
    }
    S, scanned = fit_geometry(face, {name: goals[name] for name in scans}, quick)
    known = Linearisation(face.with_weights(S))
    posterior = known.posterior([known.information(state) for state in scanned.values()])
    library = Library(known, {name: {"both": points} for name, points in goals.items()})
    gains = {each.name: each.gain_mm for each in library.rank(posterior)}
    left = [name for name in gains if name not in scans]
    tried = [left[0], *(str(name) for name in rng.choice(left[1:], OTHERS, replace=False))]
    before = unseen_error(face.with_weights(S), unseen)
    measured = []
    for name in tried:
        more, _ = fit_geometry(face, {each: goals[each] for each in (*scans, name)}, quick)
        measured.append(before - unseen_error(face.with_weights(more), unseen))
    return {
        "scans": scans,
        "tried": tried,
        "before_mm": before,
        "predicted_mm": [gains[name] for name in tried],
        "measured_mm": measured,
    }


def fit_geometry(
    face: Face, goals: Mapping[str, Floats], quick: bool
) -> tuple[sp.csr_array, dict[str, PosedFace]]:
    """Fit S to the face's points of some expressions; return their states too."""
    targets = {name: Target.from_points(points) for name, points in goals.items()}
    schedule = GeometryOptions(rounds=QUICK_ROUNDS) if quick else GeometryOptions()
    found = geometry.fit(face, distances(face, targets), schedule)
    return found.S, found.states


def unseen_error(face: Face, unseen: Mapping[str, Floats]) -> float:
    """Return the mean distance, mm, of expressions fitted by activations alone."""
    regulariser, errors = activation.unseen_regulariser(face), []
    for points in unseen.values():
        data = SkinDistance(face, Target.from_points(points))
        found = fallback.fit(face, data, regulariser, activation.UNSEEN_STOP)
        off = np.linalg.norm(face.face_points(found.state.x) - points, axis=1)
        errors.append(off.mean())
    return float(np.mean(errors))


def identifiable(model: SubjectModel) -> Figures:
    """Return the part of the muscles that markers tell, by their number."""
    face = Face(model, material=MOONEY_RIVLIN)
    strengths = np.full(model.muscle_count, STRENGTH)
    flesh = driven_by_muscles(face.flesh, FibreMuscles.of(model, face.S, strengths))
    layout = Layout((Block("activations", np.zeros(model.muscle_count)), jaw_block()))
    by_jaw = np.eye(layout.size)[layout["jaw"]]
    direct = face.mandible_jacobian(np.zeros(JAW_FREEDOM))[flesh.held]
    relaxed, x = layout.part("activations", layout.rest), model.rest
    rates = sp.eye_array(len(relaxed), layout.size, format="csr")
    boundary = BoundaryRates(direct @ by_jaw, by_jaw)
    controls = SparseControls.of(flesh, x, relaxed, rates, boundary)
    motion = Response.exact(flesh, x, relaxed).motions(controls)
    by_point = face.face_embedding @ motion.reshape(len(motion), -1)
    rows = np.asarray(by_point).reshape(len(model.face), 3, -1)
    sd = np.full(layout.size, PRIOR_SD)
    sd[layout["jaw"]] = InformationOptions().jaw_sd_mm / JAW_UNITS
    precision, muscles = np.diag(sd**-2.0), layout["activations"]

    def told(chosen: Ints) -> float:
        found = Posterior.of(rows[chosen].reshape(-1, len(sd)), NOISE_MM, precision)
        return float((found.information[muscles] > KNOWN).mean())

    spread = farthest(face.face_points(x), max(MARKERS))
    nothing = Posterior.of_normal(np.zeros_like(precision), precision)
    greedy = np.array([point for point, _ in nothing.greedy(rows, max(MARKERS), NOISE_MM)])
    figures = {str(count): told(spread[:count]) for count in MARKERS}
    return figures | {f"greedy_{count}": told(greedy[:count]) for count in MARKERS}


def farthest(points: Floats, count: int) -> Ints:
    """Return points that are each as far as can be from those before, from the middle one on."""
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())]
    distance = np.full(len(points), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return np.array(chosen)


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    scans, tells = figures["next_scan"], figures["identifiable"]
    words = {
        "better_than_random": "draws in which it beats the median of five others",
        "gain_correlation": "correlation of predicted and measured gain",
        "rank_correlation": "of their ranks within a draw",
        "unseen_before_mm": "unseen, three scans, mm",
        "gain_proposed_mm": "gain by the proposed, mm",
        "gain_others_mm": "gain by others, mm",
        "draws": "draws",
    }
    muscles = [[count, tells[str(count)], tells[f"greedy_{count}"]] for count in MARKERS]
    parts: list[Table | str] = []
    if scans:
        parts.append(Table([*words.values()], [[scans[key] for key in words]]))
    parts.append(Table(["markers", "muscles told, spread evenly", "placed greedily"], muscles))
    return Section(
        title="What scans and markers tell",
        compared="The scan that `next_scan` proposes after three expressions of the template, "
        "against five others at random: by how much a fourth scan lowers the error of expressions "
        "that S has not seen. And the part of the muscles of which markers tell more than half "
        "(fibre muscles of 90 kPa, prior sd 0.3, markers of 0.5 mm, at rest, worst subject).",
        parts=parts,
    )


if __name__ == "__main__":
    main()
