"""Systems side by side, fitted to one target.

They are muscles (S), single tets (P), muscle tracks (T) and plain shapes (B).

Families of targets, each a mixture of the template's shapes on the subject's own neutral:

`in_span` has them as they are: plain shapes made these. `left_out` takes the shapes that a target
is made of out of the bases of B and T. `spoilt` has noise, holes and lips whose vertices slid, and
is judged by the clean mixture. `simulated` are made by muscles, of a finer mesh, another law and
contact: no basis holds them, and what lips do is known. Elsewhere lips have no volume to lose: what
they lose or gain is an error. S is fitted to the subject's training scans before; it and P have no
basis. The prices of weights are those of the job. `rig` has the subject's scans by all systems in
one rig, and tells what its files weigh and show.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks import report, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.simulated_targets import SIMULATED, Truths, both_sides, simulated
from benchmarks.subject_fits import by_geometry
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM, Subject
from benchmarks.system_rig import rig_figures, rig_tables
from solver.anatomy.embedding import at_nearest
from solver.fitting.face import Face
from solver.fitting.objective import Target
from solver.fitting.per_tet import PerTetOptions
from solver.fitting.tracking.dense import HeadAndFace
from solver.jobs.fits import JobPart, WarningLog, fit_unseen
from solver.mechanics.flesh import LAWS
from solver.mechanics.linear import fastest
from solver.meshio.registered import RegisteredScan
from solver.progress import silent
from solver.rig import ExpressionFit, Rig, ShapeSystem, System, TetSystem
from solver.rig.report.certificate import with_round_trips
from solver.rig.report.systems import SYSTEMS, SystemMeasures
from solver.rig.shape_fits import fit_scan
from solver.rig.tet_fits import TetFitter
from solver.surface import Floats, vertex_normals
from solver.templates.tables import CaptureSet
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.fit import ShapeFace, TrackFitOptions
from solver.tracks.plain import PlainFace
from solver.tracks.shapes import template_shapes

FAMILIES = ("in_span", "left_out", "spoilt", "simulated")
RIG = "rig"  # one of all systems
PARTS = (*FAMILIES, RIG)
MOST_EXPRESSIONS = 8  # of that rig
WITHOUT_BASIS = ("S", "P")  # systems that no shape can be taken from
# weights of shapes, those with * on both sides
MIXTURES: Mapping[str, Mapping[str, float]] = {
    "smile": {"mouthSmile*": 0.9, "cheekSquint*": 0.5, "mouthDimple*": 0.3},
    "kiss": {"mouthPucker": 0.9, "mouthRollLower": 0.2},
    "call": {"mouthFunnel": 0.6, "jawOpen": 0.4, "browOuterUp*": 0.5},
    "grimace": {"mouthStretch*": 0.8, "mouthFrown*": 0.5, "jawOpen": 0.15},
    "anger": {"browDown*": 0.9, "noseSneer*": 0.6, "mouthPress*": 0.8, "eyeSquint*": 0.4},
    "crooked": {"mouthLeft": 0.6, "jawLeft": 0.4, "mouthSmileLeft": 0.6, "browDownRight": 0.7},
}
QUICK_MIXTURES = 2
MEANS = ("mean_mm", "p95_mm", "controls_used", "seconds")  # over targets
WORST = ("lip_volume_percent", "crossing_mm", "inverted")  # of all, without their signs

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Spoil:
    """What spoils a scan."""

    noise_mm: float = 0.5  # standard deviation of each coordinate
    holes: float = 0.25  # part of the face that is not seen
    hole_mm: float = 12.0  # radius of each hole
    slide_mm: float = 3.0  # of vertices along the surface, at the lips
    near_mm: float = 10.0  # from the lips the slide falls off over
    seed: int = 7


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    subjects.add_controls(parser)
    parser.add_argument("--edge-mm", type=float, default=COARSE_EDGE_MM, help="of the tets")
    parser.add_argument("--truth-edge-mm", type=float, default=EDGE_MM, help="of `simulated`")
    parser.add_argument("--truth-law", default="neo_hookean", choices=LAWS, help="of `simulated`")
    parser.add_argument("--w-w", type=float, default=TrackFitOptions.w_w, help="price of weights")
    report.add_list(parser, "--parts", PARTS)
    report.add_list(parser, "--systems", SYSTEMS)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of the chosen subject."""
    subject = next(subjects.each(options, [options.subject], options.edge_mm))
    person = _Person(subject, options)
    families = {part: person.family(part) for part in options.parts if part != RIG}
    if RIG in options.parts:
        families[RIG] = rig_figures(person.rig(subject.captures))
    told = {"edge_mm": options.edge_mm, "w_w": options.w_w}
    return {**told, "subjects": {subject.name: {"tets": len(subject.model.tets), **families}}}


class _Person:
    """One subject with its shapes and the mixtures of them."""

    def __init__(self, subject: Subject, options: argparse.Namespace) -> None:
        self._model = subject.model
        self._options = options
        self._shapes = template_shapes(self._model, subjects.shapes(options))
        self._fit_options = replace(TrackFitOptions(), w_w=options.w_w)
        names = list(MIXTURES)[: QUICK_MIXTURES if options.quick else None]
        self._weights = {name: both_sides(MIXTURES[name]) for name in names}
        neutral = self._model.skin.vertices
        self._clean = {
            name: neutral + sum(weight * self._shapes[each] for each, weight in weights.items())
            for name, weights in self._weights.items()
        }
        self._without_basis: dict[tuple[str, str], Sequence[ExpressionFit]] = {}
        S = self._model.weights
        if "S" in options.systems:
            face = subjects.bounded(Face(self._model), options)
            begun = time.perf_counter()
            schedule = subjects.schedule(options, self._model, quick=options.quick)
            trained = by_geometry(face, subject.captures.train, schedule)
            log.info("S in %.0f s: %.3f mm", time.perf_counter() - begun, trained.mean_mm)
            self._muscles = trained.face
            S = trained.face.S
        self._measures = SystemMeasures.of(Rig(self._model, S, ()))
        self._truths = {part: Truths(self._clean, {}) for part in FAMILIES if part != "simulated"}
        if "simulated" in options.parts:
            made_by = list(SIMULATED)[: QUICK_MIXTURES if options.quick else None]
            self._truths["simulated"] = simulated(options, made_by)

    def family(self, part: str) -> Figures:
        """Return every system's figures of a family, of all targets and of each."""
        found: dict[str, dict[str, Figures]] = {}
        for name, system, fit in self._fits(part):
            figures = self._judged(fit, self._truths[part])
            log.info("%s, %s by %s: %s", part, name, system, figures)
            found.setdefault(system, {})[name] = figures
        return {
            system: {**_summary(list(each.values())), "targets": each}
            for system, each in found.items()
        }

    def _fits(self, part: str) -> Iterator[tuple[str, str, ExpressionFit]]:
        scans = self._scans(part)
        for system in self._options.systems:
            if system in WITHOUT_BASIS:
                for fit in self._fits_without_basis(system, part):
                    yield fit.name, system, fit
                continue
            face: ShapeFace[Any] | None = None
            for name, scan in scans.items():
                if face is None or part == "left_out":
                    left_out = self._weights[name] if part == "left_out" else {}
                    face = self._face(system, left_out)
                fit = fit_scan(face, name, scan, HeadAndFace(), self._fit_options)
                yield name, system, fit

    def _face(self, system: str, left_out: Mapping[str, float]) -> ShapeFace[Any]:
        """Return the face of a system whose basis lacks some shapes."""
        kept = {name: each for name, each in self._shapes.items() if name not in left_out}
        tracks = MuscleTracks.of(self._model, kept)
        if system == "B":
            return PlainFace(self._model, tracks)
        potentials = track_potentials(self._model)
        return TrackFace(self._model, tracks, potentials, linear=fastest())

    def _fits_without_basis(self, system: str, part: str) -> Sequence[ExpressionFit]:
        """Return the fits by muscles or tets, which have no basis that could lack a shape."""
        key = system, "in_span" if part == "left_out" else part
        if key not in self._without_basis:
            scans = self._scans(part)
            by_tets = system == "P"
            found = self._by_tets(scans).expressions if by_tets else self._by_muscles(scans)
            self._without_basis[key] = found
        return self._without_basis[key]

    def _by_muscles(self, scans: Mapping[str, RegisteredScan]) -> Sequence[ExpressionFit]:
        parts = scans, self._targets(scans), WarningLog(self._model, silent)
        return fit_unseen(self._muscles, *parts, JobPart(0.0, 1.0))

    def _by_tets(self, scans: Mapping[str, RegisteredScan]) -> TetSystem:
        stop = PerTetOptions(max_iterations=10) if self._options.quick else PerTetOptions()
        fitter = TetFitter(self._model, self._targets(scans), fastest(), stop)
        fitted = [fitter.fit(name, scan) for name, scan in scans.items()]
        return TetSystem(tuple(fitted), fitter.tets)

    def rig(self, captures: CaptureSet) -> Rig:
        """Return a rig of the subject's scans by all systems that are asked for."""
        most = QUICK_MIXTURES if self._options.quick else MOST_EXPRESSIONS
        chosen = [*(captures.train | captures.test).items()][:most]
        whole = np.ones(len(self._model.skin.vertices))
        scans = {name: RegisteredScan(skin.vertices, whole) for name, skin in chosen}
        systems: dict[str, System] = {}
        for letter in self._options.systems:
            if letter == "P":
                systems[letter] = self._by_tets(scans)
            elif letter != "S":
                face = self._face(letter, {})
                fitted = [
                    fit_scan(face, name, scan, HeadAndFace(), self._fit_options)
                    for name, scan in scans.items()
                ]
                systems[letter] = ShapeSystem(tuple(fitted), face.tracks.names)
        muscles: Sequence[ExpressionFit] = ()
        S = self._model.weights
        if "S" in self._options.systems:
            S = self._muscles.S
            muscles = with_round_trips(self._muscles, tuple(self._by_muscles(scans)))
        return Rig(self._model, S, tuple(muscles), systems=systems)

    def _targets(self, scans: Mapping[str, RegisteredScan]) -> dict[str, Target]:
        face = self._model.face
        return {
            name: Target.from_points(scan.vertices[face], scan.confidence[face])
            for name, scan in scans.items()
        }

    def _scans(self, part: str) -> dict[str, RegisteredScan]:
        whole = np.ones(len(self._model.skin.vertices))
        clean = self._truths[part].skins
        scans = {name: RegisteredScan(skin, whole) for name, skin in clean.items()}
        if part != "spoilt":
            return scans
        random = np.random.default_rng(Spoil.seed)
        return {name: self._spoilt(scan.vertices, random) for name, scan in scans.items()}

    def _spoilt(
        self, clean: Floats, random: np.random.Generator, spoil: Spoil = Spoil()
    ) -> RegisteredScan:
        """Return a scan as a bad day has it: see :class:`Spoil`."""
        model = self._model
        neutral = self._model.skin.vertices
        lips = np.concatenate([model.region(f"{side}_lip") for side in ("upper", "lower")])
        away = cKDTree(neutral[lips]).query(neutral)[0]
        surface = model.skin.with_vertices(clean)
        normals = vertex_normals(surface)
        along = np.array([1.0, 0.0, 0.0]) - normals[:, :1] * normals
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        slid = clean + spoil.slide_mm * np.clip(1.0 - away / spoil.near_mm, 0, 1)[:, None] * along
        moved = away < spoil.near_mm
        points = clean.copy()
        points[moved] = at_nearest(slid[moved], surface, clean)
        points += spoil.noise_mm * random.standard_normal(points.shape)
        confidence = np.ones(len(points))
        while (confidence[model.face] > 0.0).mean() > 1.0 - spoil.holes:
            middle = neutral[random.choice(model.face)]
            confidence[np.linalg.norm(neutral - middle, axis=1) < spoil.hole_mm] = 0.0
        return RegisteredScan(points, confidence)

    def _judged(self, fit: ExpressionFit, truths: Truths) -> Figures:
        """Return the figures of a fit by its distance to the clean target."""
        clean = truths.skins[fit.name]
        error = np.full(len(clean), np.nan)
        ids = self._model.face
        error[ids] = np.linalg.norm(fit.skin[ids] - clean[ids], axis=1)
        found = self._measures.figures(replace(fit, error_mm=error, target=clean))
        if found["lip_volume_percent"] is not None:
            found["lip_volume_percent"] -= 1e2 * truths.lips.get(fit.name, 0.0)
        keys = (*MEANS, *WORST, "controls", "iterations", "status")
        return {key: found[key] for key in keys}


def _summary(targets: list[Figures]) -> Figures:
    """Return the means of targets, and the worst of them."""
    known = {key: [each[key] for each in targets if each[key] is not None] for key in WORST}
    return {
        **{key: float(np.mean([each[key] for each in targets])) for key in MEANS},
        **{key: max(map(abs, each)) if each else None for key, each in known.items()},
        "lip_volume_mean_percent": float(np.abs(known["lip_volume_percent"]).mean())
        if known["lip_volume_percent"]
        else None,
        "failed": sum(each["status"] == "failed" for each in targets),
    }


COLUMNS = {
    "mean_mm": "mean, mm",
    "p95_mm": "95 %, mm",
    "lip_volume_mean_percent": "lips' volume, mean, %",
    "lip_volume_percent": "worst, %",
    "crossing_mm": "lips cross, worst, mm",
    "inverted": "inverted tets, worst",
    "controls_used": "controls that count",
    "seconds": "s a target",
    "failed": "failed",
}


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    parts: list[Table | str] = []
    for name, person in figures["subjects"].items():
        for part in FAMILIES:
            if part in person:
                rows = [
                    [f"{system}, {SYSTEMS[system]}", *(found.get(key) for key in COLUMNS)]
                    for system in SYSTEMS
                    if (found := person[part].get(system))
                ]
                caption = f"{name}, {person['tets']} tets, `{part}`:"
                parts.append(Table(["system", *COLUMNS.values()], rows, caption))
        if RIG in person:
            parts += rig_tables(name, person[RIG])
    return Section(
        title="Systems side by side",
        compared=(
            "Muscles (S, fitted to the training scans before), activations of single tets (P), "
            "muscle tracks (T) and plain shapes (B) fitted to mixtures of the template's shapes, "
            f"tets of {figures['edge_mm']:g} mm, "
            f"w_w {figures['w_w']:g} mm^2: `in_span` as they are, so that plain shapes made them; "
            "`left_out` without the shapes of the target in the bases of T and B; `spoilt` with "
            f"{Spoil.noise_mm:g} mm of noise, holes over {100 * Spoil.holes:g} % of the face and "
            f"vertices slid by {Spoil.slide_mm:g} mm along the lips, judged by the clean mixture; "
            "`simulated` made by muscles of a finer mesh, another law and contact. Distances are "
            "over the whole face, holes too; the lips' volume should not change, or in `simulated` "
            "as it does there. S begins with a template that was trained on all of these shapes, "
            "whatever is left out elsewhere; those of B ride on the tets, of which coarse ones "
            "miss some hundredths of a millimetre."
        ),
        parts=parts,
    )


if __name__ == "__main__":
    main()
