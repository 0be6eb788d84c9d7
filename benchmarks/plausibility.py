"""Distance against plausibility: fits by admissible controls whose bounds are loosened by steps.

S is fitted to every subject's strong training scans on coarse tets, once for each plausibility. A
figure of muscles is the worst over muscles and scans, ``beyond`` the sum of the muscles that do
what muscles cannot.
"""

from __future__ import annotations

import argparse
import logging

from benchmarks import documents, plots, report, subject_fits, subjects
from benchmarks.documents import Figures, Plot, Section, Table
from benchmarks.plots import Tradeoff
from benchmarks.rig_figures import muscle_figures
from benchmarks.subjects import COARSE_EDGE_MM, QUICK_ROUNDS, Subject
from solver.fitting.drives.admissible import Admissible, limits_by_plausibility
from solver.fitting.face import Face
from solver.fitting.geometry import usual_options
from solver.rig.report.certificate import muscles

STEPS = (1.0, 0.8, 0.5, 0.0)
WORST = {  # figures of a fit -> their words
    "stretch_longest": "greatest stretch",
    "fibres_longest": "longest fibres",
    "volume_worst_percent": "change of volume, %",
}

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_folders(parser)
    parser.add_argument("--subjects", default="A,B,C", help="of --faces, joined by commas")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of every subject."""
    rounds = QUICK_ROUNDS if options.quick else None
    names = options.subjects.split(",")[: 1 if options.quick else None]
    people = {
        subject.name: [_fit(subject, plausibility, rounds) for plausibility in STEPS]
        for subject in subjects.each(options, names, COARSE_EDGE_MM)
    }
    return {"subjects": people}


def _fit(subject: Subject, plausibility: float, rounds: int | None) -> Figures:
    within = Admissible(limits_by_plausibility(plausibility))
    schedule = usual_options(subject.model, within, rounds)
    fits = subject_fits.by_geometry(Face(subject.model), subject.sets["strong"].train, schedule)
    face = fits.face
    found = [
        muscles(face.model, face.flesh.volumes, face.S, state.pose.a)
        for state in fits.states.values()
    ]
    figures: Figures = {
        "plausibility": plausibility,
        "train_mean_mm": fits.mean_mm,
        "beyond": sum(bool(each.faults(m)) for each in found for m in range(len(each.fibres))),
        **muscle_figures(found),
        "inverted": fits.count_inverted(),
        "rounds": fits.rounds,
        "seconds": fits.seconds,
    }
    log.info("%s: %s", subject.name, figures)
    return figures


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    people: dict[str, list[Figures]] = figures["subjects"]
    columns = {"train_mean_mm": "training, mm", **WORST, "beyond": "muscles beyond, sum"}
    rows = [
        [name, each["plausibility"], *(each[key] for key in columns)]
        for name, found in people.items()
        for each in found
    ]
    plot = documents.IMAGES / "plausibility-curve.png"
    lines = {
        name: Tradeoff(
            [each["train_mean_mm"] for each in found],
            {words: [each[key] for each in found] for key, words in WORST.items()},
        )
        for name, found in people.items()
    }
    steps = [f"{each['plausibility']:g}" for each in next(iter(people.values()))]
    plots.tradeoff(plot, "Mean distance to the scan", "mm", steps, lines)
    return Section(
        title="Plausibility",
        compared="Fits of S to the five strong scans by admissible controls, whose bounds "
        "`plausibility` loosens from 1, what muscles can do, to 0, nearly free. Figures of muscles "
        "are the worst of all muscles in all scans. Tets are coarse, so that only differences "
        "between the rows count.",
        parts=[
            Plot(plot, "Distance to the scan against what muscles do, by plausibility"),
            Table(["subject", "plausibility", *columns.values()], rows),
        ],
    )


if __name__ == "__main__":
    main()
