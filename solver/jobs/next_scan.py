"""The job that proposes which expressions to scan next."""

from __future__ import annotations

import time
from pathlib import Path

from solver.anatomy.template import ShapeBasis
from solver.fitting.face import Face, Pose
from solver.fitting.geometry_information import InformationOptions, Linearisation, MuscleInformation
from solver.fitting.target_checks import check_held
from solver.jobs import Task, read_template
from solver.jobs.fits import known_basis
from solver.kinds.next_scan import NextScan
from solver.mechanics.linear import fastest
from solver.progress import Step
from solver.rig import Rig
from solver.rig.next_scan import (
    Library,
    library_poses,
    library_targets,
    suggestion_figures,
    suggestion_words,
)
from solver.rig.report import information_figures
from solver.rig.report.certificate import scan_information
from solver.storage import write_json

SCANNED = 0.2  # part of a job after which the rig's own scans are read


def run(task: Task[NextScan]) -> list[Path]:
    """Rank the template's expressions by what each would add to the rig's training scans.

    Raises :class:`solver.errors.InputError` as :func:`solver.rig.next_scan.library_targets`, and
    :class:`solver.errors.SolveError` (``fit.failed``) where no expression can be fitted.
    """
    given = task.options
    progress = task.progress
    progress(Step("read", 0.0, message=task.inputs["rig"].name))
    begin = time.perf_counter()
    rig = Rig.load(task.inputs)
    anatomy = read_template(task)
    targets = library_targets(rig.model, anatomy.shapes)
    own = rig.face(fastest())
    face = own.with_free_jaw()  # as the certificate judges scans
    check_held(face)
    linearisation = Linearisation(face, options=InformationOptions(noise_mm=given.noise_mm))
    progress(Step("scans", 0.05))
    scanned = scan_information(linearisation, rig)
    posterior = linearisation.posterior(scanned)

    def listen(name: str, number: int) -> None:
        done = SCANNED + (0.95 - SCANNED) * number / len(targets)
        progress(Step("library", done, number + 1, message=name))

    near = _near(task, face, own, anatomy.shapes)
    library = Library(linearisation, scanned, targets, listen=listen, near=near)
    suggestions = library.suggest(given.count)
    words = suggestion_words(suggestions)
    muscles = MuscleInformation.of(posterior, linearisation.modes.places, len(scanned))
    ranked = library.rank()
    report = {
        "words": words,
        "next": [suggestion_figures(each) for each in suggestions],
        "expected_mm": round(ranked[0].before_mm, 4),
        "library": {each.name: round(each.gain_mm, 4) for each in ranked},
        "failed": library.failed,
        "information": information_figures(rig.model, muscles),
        "seconds": round(time.perf_counter() - begin, 1),
    }
    file = task.out / "next_scan.json"
    write_json(file, report)
    progress(Step("done", 1.0, message=words))
    return [file]


def _near(
    task: Task[NextScan], face: Face, own: Face, shapes: ShapeBasis | None
) -> dict[str, dict[str, Pose]]:
    """Return the poses that the library's fits begin with, of a basis if one was left.

    No basis is solved here: that takes as long as the library itself, while the person waits.
    """
    basis = known_basis(task, own, shapes.expressions, 0.0) if shapes else None
    if shapes is None or basis is None:
        return {}
    known = dict(zip(shapes.expression_names, basis.whole, strict=True))
    return library_poses(face, own, known)
