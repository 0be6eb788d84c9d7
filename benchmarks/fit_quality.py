"""How near fitted faces come to their scans, on expressions that S was fitted to and on others.

For every subject of the capture sets S is fitted to the training scans and activations alone to
the test scans, by the functions and weights of the jobs. Distances are over the face skin, vertex
by vertex, in mm. ``ablation_ratio`` is the training scans' mean error with activations alone (the
geometric S of the model) over that with the fitted S; ``three_scans_test_mean_mm`` the test scans'
with an S fitted to the first three training scans. The worst subject stands at top level.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from benchmarks import documents, plots, report, subjects
from benchmarks.documents import Figures, Plot, Section, Table
from solver.anatomy.capture_set import CaptureSet
from solver.errors import InputError
from solver.fitting import activation, geometry, standard
from solver.fitting.face import Face, State
from solver.fitting.geometry import GeometryOptions
from solver.fitting.objective import Target
from solver.model import SubjectModel
from solver.surface import Surface

EDGE_MM, COARSE_EDGE_MM = 9.0, 18.0
QUICK_ROUNDS = 6
FEW_SCANS = 3

DETAILS = {
    "mean_mm": "mean, mm",
    "p95_mm": "95 % below, mm",
    "max_mm": "max, mm",
    "inverted": "inverted tets",
}
"""What is measured of every expression, and its heading."""

log = logging.getLogger("fit_quality")


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_folders(parser)
    parser.add_argument("--subjects", type=_names, default=["A", "B", "C"], metavar="LIST")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    try:
        figures = run(options)
    except InputError as fault:
        raise SystemExit(f"{fault.code}: {fault.message}") from None
    report.finish(figures, options, section)


def _names(text: str) -> list[str]:
    names = [word.strip() for word in text.split(",") if word.strip()]
    if not names:
        raise argparse.ArgumentTypeError("at least one subject")
    return list(dict.fromkeys(names))


def run(options: argparse.Namespace) -> Figures:
    """Fit every subject and return the figures."""
    names = options.subjects[: 1 if options.quick else None]
    edge = COARSE_EDGE_MM if options.quick else EDGE_MM
    schedule = GeometryOptions(rounds=QUICK_ROUNDS) if options.quick else GeometryOptions()
    people = {
        name: _subject(name, model, captures, schedule)
        for name, model, captures in subjects.each(options, names, edge)
    }
    return {**_worst(list(people.values())), "subjects": people}


def _worst(people: list[Figures]) -> Figures:
    """Return the figures of the worst subject, each by itself; None where no subject has one."""
    bars: dict[str, Callable[[list[Any]], Any]] = {
        "train_mean_mm": max,
        "test_mean_mm": max,
        "inverted": sum,
        "ablation_ratio": min,
        "three_scans_test_mean_mm": max,
    }
    found: Figures = {}
    for key, choose in bars.items():
        values = [person[key] for person in people if person[key] is not None]
        found[key] = choose(values) if values else None
    return found


@dataclass(frozen=True)
class _Fits:
    """Settled fits of several scans of one subject, and how long they took."""

    face: Face
    targets: dict[str, Target]
    states: dict[str, State]
    seconds: float

    @property
    def mean_mm(self) -> float | None:
        """The mean distance over expressions and face skin; None without expressions."""
        return self.mean() if self.states else None

    def mean(self) -> float:
        """Return the mean distance over expressions and face skin."""
        return geometry.mean_error(self.face, self.targets, self.states)

    def expressions(self, role: str) -> dict[str, Figures]:
        """Return the figures of every expression."""
        return {name: {"role": role, **self._expression(name)} for name in self.states}

    def _expression(self, name: str) -> Figures:
        x = self.states[name].x
        distance = self.targets[name].distances(self.face.face_points(x))
        return {
            "mean_mm": float(np.nanmean(distance)),
            "p95_mm": float(np.nanpercentile(distance, 95)),
            "max_mm": float(np.nanmax(distance)),
            "inverted": self.face.flesh.inverted(x),
        }


def _subject(
    name: str, model: SubjectModel, captures: CaptureSet, schedule: GeometryOptions
) -> Figures:
    log.info("%s: %d vertices, %d tets", name, len(model.rest), len(model.tets))
    if not captures.train:
        raise InputError("captures.empty", "the capture sets have no training expression")
    face = Face(model)
    S, train = _geometry(face, captures.train, schedule)
    log.info("%s: training scans %.3f mm, %.0f s", name, train.mean_mm, train.seconds)
    test = _activations(face, S, captures.test)
    log.info("%s: test scans %s mm, %.0f s", name, test.mean_mm, test.seconds)
    alone = _activations(face, model.weights, captures.train)
    log.info("%s: S as in the model %.3f mm, %.0f s", name, alone.mean_mm, alone.seconds)
    few = _few_scans(face, captures, schedule)
    log.info("%s: test scans by three %s mm, %.0f s", name, few.mean_mm, few.seconds)
    expressions = {**train.expressions("train"), **test.expressions("test")}
    return {
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "muscles": model.muscle_count,
        "train_mean_mm": train.mean_mm,
        "test_mean_mm": test.mean_mm,
        "inverted": sum(figures["inverted"] for figures in expressions.values()),
        "ablation_mean_mm": alone.mean_mm,
        "ablation_ratio": alone.mean() / train.mean(),
        "three_scans_test_mean_mm": few.mean_mm,
        "seconds": {
            "geometry": train.seconds,
            "test": test.seconds,
            "ablation": alone.seconds,
            "three_scans": few.seconds,
        },
        "expressions": expressions,
    }


def _geometry(
    face: Face, scans: dict[str, Surface], schedule: GeometryOptions
) -> tuple[sp.csr_array, _Fits]:
    targets = _targets(face, scans)

    def listen(number: int, states: Mapping[str, State]) -> None:
        log.info("round %d: %.3f mm", number, geometry.mean_error(face, targets, states))

    start = time.perf_counter()
    fitted = geometry.fit(face, standard.terms(face, targets), schedule, listen=listen)
    return fitted.S, _Fits(face, targets, fitted.states, time.perf_counter() - start)


def _activations(face: Face, S: sp.csr_array, scans: dict[str, Surface]) -> _Fits:
    targets = _targets(face, scans)
    regulariser, rest = standard.unseen_regulariser(face), face.rest_state(S)
    start = time.perf_counter()
    states = {}
    for name, term in standard.terms(face, targets).items():
        fitted = activation.fit(face, S, term, regulariser, rest, standard.UNSEEN_STOP)
        states[name] = fitted.state
    return _Fits(face, targets, states, time.perf_counter() - start)


def _few_scans(face: Face, captures: CaptureSet, schedule: GeometryOptions) -> _Fits:
    """Return the test scans by an S from the first training scans; none if there are no more."""
    if len(captures.train) <= FEW_SCANS:
        return _Fits(face, {}, {}, 0.0)
    S, train = _geometry(face, captures.first(FEW_SCANS, 0).train, schedule)
    test = _activations(face, S, captures.test)
    return _Fits(face, test.targets, test.states, train.seconds + test.seconds)


def _targets(face: Face, scans: dict[str, Surface]) -> dict[str, Target]:
    ids = face.model.face
    return {name: Target.from_points(scan.vertices[ids]) for name, scan in scans.items()}


def section(figures: Figures) -> Section:
    """Return the document's section."""
    people: dict[str, Figures] = figures["subjects"]
    columns = {
        "train_mean_mm": "training, mm",
        "test_mean_mm": "unseen, mm",
        "ablation_mean_mm": "geometric S, training, mm",
        "three_scans_test_mean_mm": "S of three scans, unseen, mm",
        "inverted": "inverted tets",
    }
    rows = [[name, *(person[key] for key in columns)] for name, person in people.items()]
    names = list(next(iter(people.values()))["expressions"])
    details = [
        [subject, name, found["role"], *(found[key] for key in DETAILS)]
        for subject, person in people.items()
        for name, found in person["expressions"].items()
    ]
    plot = documents.IMAGES / "fit_quality-errors.png"
    means = {
        subject: [person["expressions"][name]["mean_mm"] for name in names]
        for subject, person in people.items()
    }
    plots.bars(plot, "Mean distance to the scan", "mm", names, means)
    return Section(
        title="Fit quality",
        compared=(
            "Fitted faces against the scans they were fitted to, vertex by vertex over the face "
            "skin. S is fitted to the training scans; the unseen ones are fitted by activations "
            "and jaw alone. For comparison: the training scans by activations with the geometric "
            "S of the model, and the unseen ones with an S of the first three training scans."
        ),
        parts=[
            Table(["subject", *columns.values()], rows),
            Plot(plot, "Mean distance to the scan of every expression"),
            Table(["subject", "expression", "role", *DETAILS.values()], details),
        ],
    )


if __name__ == "__main__":
    main()
