"""Proposals of the next scan against others at random, and the muscles that markers determine.

``next_scan``: three expressions of the template are drawn, S is fitted to them, and the library is
ranked as by the job ``next_scan``. Then S is fitted again with the expression it proposes, and with
five others drawn at random, and the capture set's expressions, none of which S has seen, are fitted
by activations alone. ``better_than_random`` is the part of the draws in which the proposed one
lowers their mean error more than the median of the five; ``gain_correlation`` is that between
predicted and measured gains over all draws, ``rank_correlation`` that of their ranks within a draw.
A draw is seven fits of S: ten draws of three subjects take an hour with ``--coarse --rounds 4``.

``identifiable``: the part of the muscles whose information by a set of markers is above a half, by
fibre muscles calibrated to the capture set's training scans with activations of prior sd 0.3, and
markers of 0.5 mm as :mod:`benchmarks.markers` places them, linearised at rest. ``greedy_K`` has
each marker where it helps most; ``uncalibrated_K`` are muscles of 90 kPa with the person's S, and
``template_K`` the same with the template's. Worst subject.
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
from benchmarks.made_takes import SHARES, marker_triangles
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.fitting import activation, fallback, geometry
from solver.fitting.activation import ActivationOptions
from solver.fitting.calibration import calibrate, fibre_muscles, with_fibres
from solver.fitting.face import Face, PosedFace
from solver.fitting.geometry import GeometryOptions
from solver.fitting.geometry_information import Linearisation, pose_precision
from solver.fitting.information import Posterior
from solver.fitting.objective import SkinDistance, Target, distances
from solver.fitting.sensitivity import Sensitivity
from solver.mechanics.flesh import MOONEY_RIVLIN
from solver.rig.next_scan import Library, library_targets
from solver.surface import Floats
from solver.templates.builtin.build import builtin_template
from solver.templates.ict_facekit import read_facekit, shape_basis
from solver.templates.tables import CaptureSet

SCANS = 3
OTHERS = 5
QUICK_ROUNDS = 4
UNSEEN_STOP = ActivationOptions(max_iterations=8, tolerance=1e-2)
MARKERS = (79, 40, 17)
NOISE_MM = 0.5  # of a marker
KNOWN = 0.5  # information from which on a muscle counts as identifiable

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_folders(parser)
    parser.add_argument("--subjects", default="A,B,C", metavar="LIST")
    parser.add_argument("--draws", type=int, default=10, help="draws of three scans a subject")
    parser.add_argument("--rounds", type=int, help="of a fit of S")
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
    rounds = options.rounds or (QUICK_ROUNDS if options.quick else GeometryOptions.rounds)
    people = {}
    draws = []
    for subject in subjects.each(options, options.subjects.split(","), edge):
        name = subject.name
        model = subject.model
        captures = subject.captures
        face = Face(model)
        trained = {name: scan.vertices[model.face] for name, scan in captures.train.items()}
        people[name] = measure_identifiability(face, trained, rounds)
        log.info("%s: %s", name, people[name])
        targets = library_targets(model, shapes)
        goals = {shape: sides["both"] for shape, sides in targets.items()}
        for seed in range(options.draws):
            found = draw(face, goals, captures, np.random.default_rng(seed), rounds)
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
    rounds: int,
) -> Figures:
    """Return predicted and measured gains, mm, of the proposed expression and of five others."""
    scans = [str(name) for name in rng.choice(list(goals), SCANS, replace=False)]
    unseen = {
        name: scan.vertices[face.model.face]
        for name, scan in {**captures.train, **captures.test}.items()
    }
    S, scanned = fit_geometry(face, {name: goals[name] for name in scans}, rounds)
    known = Linearisation(face.with_weights(S))
    information = [known.information(state) for state in scanned.values()]
    library = Library(known, information, {name: {"both": each} for name, each in goals.items()})
    gains = {each.name: each.gain_mm for each in library.rank()}
    left = [name for name in gains if name not in scans]
    tried = [left[0], *(str(name) for name in rng.choice(left[1:], OTHERS, replace=False))]
    rest = dict.fromkeys(unseen, face.rest)
    _, states = fit_unseen(known.face, unseen, rest)
    # all are measured after as many iterations, from the same poses
    before, _ = fit_unseen(known.face, unseen, states)
    measured = []
    for name in tried:
        more, _ = fit_geometry(face, {each: goals[each] for each in (*scans, name)}, rounds)
        after, _ = fit_unseen(face.with_weights(more), unseen, states)
        measured.append(before - after)
    return {
        "scans": scans,
        "tried": tried,
        "before_mm": before,
        "predicted_mm": [gains[name] for name in tried],
        "measured_mm": measured,
    }


def fit_geometry(
    face: Face, goals: Mapping[str, Floats], rounds: int
) -> tuple[sp.csr_array, dict[str, PosedFace]]:
    """Fit S to the face's points of some expressions; return their states too."""
    targets = {name: Target.from_points(points) for name, points in goals.items()}
    found = geometry.fit(face, distances(face, targets), GeometryOptions(rounds=rounds))
    return found.S, found.states


def fit_unseen(
    face: Face, unseen: Mapping[str, Floats], states: Mapping[str, PosedFace]
) -> tuple[float, dict[str, PosedFace]]:
    """Fit expressions by activations alone; return their mean distance in mm and their states."""
    regulariser = activation.unseen_regulariser(face)
    errors = []
    found = {}
    for name, points in unseen.items():
        data = SkinDistance(face, Target.from_points(points))
        start = face.settle(states[name].pose, states[name].x)
        found[name] = fallback.fit(face, data, regulariser, UNSEEN_STOP, start=start).state
        off = np.linalg.norm(face.face_points(found[name].x) - points, axis=1)
        errors.append(off.mean())
    return float(np.mean(errors)), found


def measure_identifiability(face: Face, scans: Mapping[str, Floats], rounds: int) -> Figures:
    """Return the part of the muscles that markers determine, calibrated to scans (k, 3) or not."""
    S, _ = fit_geometry(face, scans, rounds)
    template = Face(face.model, material=MOONEY_RIVLIN)
    plain = template.with_weights(S)
    targets = {name: Target.from_points(points) for name, points in scans.items()}
    found = muscle_shares(calibrate(plain, distances(plain, targets)).face)
    for name, before in (("uncalibrated", plain), ("template", template)):
        parts = muscle_shares(with_fibres(before, fibre_muscles(before)))
        found |= {f"{name}_{key}": part for key, part in parts.items()}
    return found


def muscle_shares(face: Face) -> Figures:
    """Return the part of a face's fibre muscles that markers determine, by the markers' number."""
    model = face.model
    jacobian = Sensitivity(face, face.rest).by_pose()
    motions = jacobian.motion(sp.kron(face.face_embedding, sp.eye_array(3), format="csr"))
    points = motions.reshape(len(model.face), 3, -1)
    number = np.zeros(len(model.skin.vertices), np.int64)
    number[model.face] = np.arange(len(model.face))
    corners = points[number[marker_triangles(model, max(MARKERS))]]
    placed = np.einsum("c,kcdq->kdq", SHARES, corners)
    nothing = Posterior.of_normal(0.0, precision := pose_precision(face))
    best = [point for point, _ in nothing.greedy(points, max(MARKERS), NOISE_MM)]
    muscles = face.layout.muscles

    def known(rows: Floats) -> float:
        found = Posterior.of(rows.reshape(-1, len(precision)), NOISE_MM, precision)
        return float((found.information[muscles] > KNOWN).mean())

    figures = {str(count): known(placed[:count]) for count in MARKERS}
    return figures | {f"greedy_{count}": known(points[best[:count]]) for count in MARKERS}


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    scans = figures["next_scan"]
    shares = figures["identifiable"]
    words = {
        "better_than_random": "draws in which it beats the median of five others",
        "gain_correlation": "correlation of predicted and measured gain",
        "rank_correlation": "of their ranks within a draw",
        "unseen_before_mm": "unseen, three scans, mm",
        "gain_proposed_mm": "gain by the proposed, mm",
        "gain_others_mm": "gain by others, mm",
        "draws": "draws",
    }
    kinds = {
        "": "muscles determined",
        "greedy_": "placed greedily",
        "uncalibrated_": "at 90 kPa",
        "template_": "and with the template's S",
    }
    muscles = [[count, *(shares[f"{kind}{count}"] for kind in kinds)] for count in MARKERS]
    parts: list[Table | str] = []
    if scans:
        parts.append(Table([*words.values()], [[scans[key] for key in words]]))
    parts.append(Table(["markers", *kinds.values()], muscles))
    return Section(
        title="Information of scans and markers",
        compared="The scan that `next_scan` proposes after three expressions of the template, "
        "against five others at random: by how much a fourth scan lowers the error of expressions "
        "that S has not seen. And the part of the muscles whose information by markers is above a "
        "half (fibre muscles calibrated to five scans, prior sd 0.3, markers of 0.5 mm, at rest, "
        "worst subject).",
        parts=parts,
    )


if __name__ == "__main__":
    main()
