"""Shared by fits: scans, targets, warnings, the rig that is left, and its basis of expressions."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from solver.errors import Finding, InputError, SolveError, make_warning
from solver.fitting import fallback
from solver.fitting.activation import UNSEEN_STOP, ActivationOptions, unseen_regulariser
from solver.fitting.contact import terms
from solver.fitting.drives import MuscleDrive
from solver.fitting.drives.admissible import Admissible, limits_by_plausibility
from solver.fitting.drives.six_numbers import SixNumbers
from solver.fitting.drives.stored import store
from solver.fitting.expression_basis import FILE as BASIS_FILE
from solver.fitting.expression_basis import OTHER, ExpressionBasis
from solver.fitting.face import Face
from solver.fitting.fallback import FallbackFit, Solver
from solver.fitting.geometry_information import MuscleInformation
from solver.fitting.known import NOTHING_KNOWN, FaceMuscles, find_disagreements
from solver.fitting.least_squares import Listener
from solver.fitting.objective import Target
from solver.fitting.recruitment_checks import check_recruitment
from solver.fitting.target_checks import after_fit, before_fit, find_inflated, idle_muscles
from solver.jobs import Task
from solver.kinds.kind import Distance, ExpressionFitOptions
from solver.mechanics.flesh import IDENTITY
from solver.meshio.registered import RegisteredScan, read_registered
from solver.model import SubjectModel
from solver.progress import ProgressCallback, Step
from solver.rig import ExpressionFit, Rig, System
from solver.rig.exporters import write_rig
from solver.rig.expression import errors_on_skin, refuse_not_finite
from solver.rig.report.certificate import certify, with_round_trips
from solver.scans.known_activations import NOTHING, KnownMuscles, read_known
from solver.surface import Floats, Ints, Surface, vertex_normals

Fit = TypeVar("Fit", bound=ExpressionFit)


def asked_drive(options: ExpressionFitOptions, own: MuscleDrive | None = None) -> MuscleDrive:
    """Return the drive that a job asks for; if it asks for none ``own``, else an admissible one.

    IPOPT knows no bounds, so that it fits free muscles unless others are asked for. Raises
    :class:`InputError` (``rig.drive``) where a rig's own drive is no six numbers a muscle.
    """
    if options.controls == "free" or (options.controls is None and options.solver == "ipopt"):
        return SixNumbers()
    if own and options.controls is None and "plausibility" not in options.model_fields_set:
        if not isinstance(own, SixNumbers):
            message = f"the rig is driven by {own.name}, and the job fits six numbers a muscle"
            expected = ["free", "admissible"]
            raise InputError("rig.drive", f"{message}: give controls", expected=expected)
        return own
    return Admissible(limits_by_plausibility(options.plausibility))


def control_settings(drive: MuscleDrive) -> dict[str, Any]:
    """Return the settings that say what muscles may do."""
    stored = store(drive)
    return {"controls": stored.pop("name"), **stored}


def read_rig_or_model(task: Task[Any]) -> Rig:
    """Return a job's rig; of a model alone, that person as built, without expressions.

    Its muscles may do what a fit of expressions lets them by default. Raises :class:`InputError`:
    ``job.missing`` without either, and as the files' readers.
    """
    files = task.inputs
    if "rig" in files or "weights" in files:
        return Rig.load(files)
    if "model" in files:
        model = SubjectModel.load(files["model"])
        return Rig(model, model.weights, (), drive=Admissible())
    raise InputError("job.missing", "the job needs a rig or a model", expected=["rig", "model"])


def read_scans(subject: SubjectModel, captures: Mapping[str, Path]) -> dict[str, RegisteredScan]:
    """Read registered scans; faults of all are raised at once, so that all can be mended."""
    if not captures:
        raise InputError("fit.no_captures", "a fit needs at least one expression scan")
    skin = subject.skin
    scans: dict[str, RegisteredScan] = {}
    faults: list[InputError] = []
    for name, path in captures.items():
        try:
            scan = read_registered(path, skin.faces, len(skin.vertices), neutral=skin.vertices)
            if not scan.confidence[subject.face].any():
                message = f"{path.name} has no confidence on the face"
                raise InputError("scan.confidence", message, file=path.name)
            scans[name] = scan
        except InputError as fault:
            faults.append(fault)
    if len(faults) == 1:
        raise faults[0]
    if faults:
        messages = "; ".join(fault.message for fault in faults)
        message = f"{len(faults)} scans cannot be used: {messages}"
        raise InputError("scan.several", message, faults=[fault.as_dict() for fault in faults])
    return scans


def read_known_scans(
    task: Task[Any], face: Face, scans: Mapping[str, RegisteredScan]
) -> dict[str, KnownMuscles]:
    """Return scan -> what the job's table knows of muscles in it; {} without a table."""
    if "activations" not in task.inputs:
        return {}
    muscles = FaceMuscles.of(face)
    table = read_known(task.inputs["activations"], muscles.names)
    muscles.check(table.names)
    return table.of_expressions([*scans])


def find_oddities(
    face: Face,
    scans: Mapping[str, RegisteredScan],
    targets: Mapping[str, Target],
    drive: MuscleDrive,
) -> list[Finding]:
    """Return what is odd about a face and scans, with their targets, before a drive fits them."""
    found = [
        *idle_muscles(face),
        *before_fit(face.model, scans),
        *check_recruitment(face, targets),
        *drive.lacks(face.model),
    ]
    if drive.loosen(0.0) is not None and face.model.jaw.tracks is None:
        message = "the model has no tracks of its condyles, so that its jaw is free: build it again"
        found.append(make_warning("model.no_tracks", message))
    return found


def refuse_failures(fits: Sequence[ExpressionFit]) -> None:
    """Raise ``fit.failed`` if no expression could be fitted at all: there is nothing to keep."""
    if all(fit.status == "failed" and np.allclose(fit.activations, IDENTITY) for fit in fits):
        reasons = [f"{fit.name}: {notice.message}" for fit in fits for notice in fit.notices]
        message = f"no expression could be fitted ({'; '.join(reasons)})"
        raise SolveError("fit.failed", message)


def fit_unseen(
    face: Face,
    scans: Mapping[str, RegisteredScan],
    targets: Mapping[str, Target],
    log: WarningLog,
    span: JobPart,
    knowledge: Mapping[str, KnownMuscles] = NOTHING_KNOWN,
    stop: ActivationOptions = UNSEEN_STOP,
    solver: Solver = "reduced",
) -> list[ExpressionFit]:
    """Fit activations and jaw to every scan with the S of ``face``, and log what is odd.

    ``span`` is the part of the job that this is. Raises as :func:`refuse_failures`.
    """
    data = terms(face, targets)
    fitted = []
    for number, (name, scan) in enumerate(scans.items()):
        part = span.part(number, len(scans))
        listen = log.listener("activations", name, part, stop.max_iterations)

        start = time.perf_counter()
        known = knowledge.get(name, NOTHING)
        prior = unseen_regulariser(face, targets[name], known)
        found = fallback.fit(face, data[name], prior, stop, solver, listen)
        spent = time.perf_counter() - start
        about = (face, name, "test", scan, targets[name])
        expression = describe_fit(*about, found, spent, known)
        fitted.append(log.about(expression, part.end, found.notices))
    refuse_failures(fitted)
    return fitted


def describe_fit(
    face: Face,
    name: str,
    role: str,
    scan: RegisteredScan,
    target: Target,
    found: FallbackFit,
    seconds: float,
    known: KnownMuscles = NOTHING,
) -> ExpressionFit:
    """Return a fit with its distances and what is ``known`` of muscles, beside what they do.

    Raises ``solve.not_finite`` rather than write NaN.
    """
    state = found.state
    refuse_not_finite(name, state)
    points = face.face_points(state.x)
    return ExpressionFit(
        name=name,
        role=role,
        activations=state.pose.a,
        jaw=face.five_jaw_numbers(state.pose.b),
        skin=face.whole_skin(state.x, state.pose.b),
        target=scan.vertices,
        error_mm=errors_on_skin(face.model, target, points),
        inverted=face.flesh.count_inverted(state.x),
        iterations=found.iterations,
        seconds=seconds,
        objective=target.value(points),
        x=state.x,
        solver=found.solver,
        status=found.status,
        confidence=scan.confidence,
        known=FaceMuscles.of(face).compare(known, state.pose.a) if len(known) else (),
    )


def carried_systems(parent: Rig, scans: Mapping[str, RegisteredScan]) -> dict[str, System]:
    """Return a rig's other systems without expressions of which ``scans`` are other ones."""
    found = {name: scan.vertices for name, scan in scans.items()}
    return {name: system.without(found) for name, system in parent.systems.items()}


def leave_rig(
    face: Face,
    rig: Rig,
    settings: dict[str, Any],
    out: Path,
    progress: ProgressCallback,
    information: MuscleInformation | None = None,
) -> list[Path]:
    """Check what was fitted and write the rig's files, and those that show its systems.

    ``progress`` counts from 0 to 1 here. ``information`` is that of a parent with the same S and
    training scans, where there is one.
    """

    def listen(name: str, number: int) -> None:
        part = 0.85 * number / len(rig.expressions)
        progress(Step("round_trip", part, number + 1, message=name))

    start = time.perf_counter()
    face = face.with_weights(rig.weights)
    fits = with_round_trips(face, rig.expressions, listen)
    seconds = {**rig.seconds, "round_trip": time.perf_counter() - start}
    rig = replace(rig, expressions=fits, seconds=seconds)
    progress(Step("export", 0.85, message="certificate, exports and pictures"))
    files = write_rig(rig, certify(face, rig, settings, information), out)
    progress(Step("done", 1.0))
    return files


# Registered scans as targets: the distance to their points, or to their surface.


class Targets:
    """Makes targets of the scans of one person.

    Along the surface the distance ``plane`` lets the skin slide: registration is least certain in
    that direction.
    """

    def __init__(self, model: SubjectModel, distance: Distance) -> None:
        self._face = model.face
        self._distance = distance
        self._triangles = model.face_triangles

    def of_scans(self, scans: Mapping[str, RegisteredScan]) -> dict[str, Target]:
        """Return the targets of scans of the whole topology by their names."""
        face = self._face
        return {
            name: self.of_points(scan.vertices[face], scan.confidence[face])
            for name, scan in scans.items()
        }

    def of_points(self, points: Floats, confidence: Floats) -> Target:
        """Return the target of the face's points (k, 3), NaN where nothing was seen."""
        if self._distance == "point":
            return Target.from_points(points, confidence)
        return Target.from_points(points, confidence, _normals(points, self._triangles))


def _normals(points: Floats, triangles: Ints) -> Floats:
    """Return the unit normals (k, 3) of what is seen; NaN at a point of no triangle."""
    whole = triangles[np.isfinite(points[triangles]).all(axis=(1, 2))]
    normals = vertex_normals(Surface(np.nan_to_num(points), whole))
    normals[np.bincount(whole.ravel(), minlength=len(points)) == 0] = np.nan
    return normals


@dataclass(frozen=True)
class JobPart:
    """A part of a job, from one fraction of it to another."""

    start: float
    end: float

    def at(self, part: float) -> float:
        """Return the fraction of the job that is done when a ``part`` of the span is."""
        return self.start + part * (self.end - self.start)

    def part(self, number: int, count: int) -> JobPart:
        """Return one of ``count`` equal parts."""
        return JobPart(self.at(number / count), self.at((number + 1) / count))


# The warnings of a job: sent while it runs, and kept for its report.


class WarningLog:
    """Notices are sent as steps of the phase ``warning`` and sorted by expression."""

    def __init__(self, model: SubjectModel, progress: ProgressCallback) -> None:
        self._model = model
        self._progress = progress
        self._notices: list[Finding] = []

    def branch(self) -> WarningLog:
        """Return a new log for further fits of the same expressions, with the notices so far."""
        other = WarningLog(self._model, self._progress)
        other._notices = [*self._notices]
        return other

    def listener(self, phase: str, name: str, span: JobPart, most: int) -> Listener:
        """Return what tells of the iterations, ``most`` at most, of a fit of ``name``."""

        def listen(iteration: int, value: float) -> None:
            done = span.at(min(iteration / most, 1.0))
            self._progress(Step(phase, done, iteration, value, message=name))

        return listen

    def warn(self, fraction: float, notices: Iterable[Finding]) -> None:
        """Send notices as warnings when ``fraction`` of the job is done."""
        for notice in notices:
            self._notices.append(notice)
            self._progress(Step("warning", fraction, message=notice.message))

    def about(self, fit: Fit, fraction: float, solve: Iterable[Finding]) -> Fit:
        """Return a fit with its notices: from its checks, its ``solve`` and its result."""
        own = {"expression": fit.name}
        self.warn(fraction, [replace(each, context={**own, **each.context}) for each in solve])
        self.warn(fraction, find_disagreements(fit.name, fit.known))
        inflated = find_inflated(self._model, fit.name, fit.target, fit.skin)
        self.warn(fraction, inflated or after_fit(self._model, fit.name, fit.error_mm))
        mine = [each for each in self._notices if each.context.get("expression") == fit.name]
        return replace(fit, notices=tuple(mine))

    @property
    def general(self) -> tuple[Finding, ...]:
        """Return the notices that are about no expression."""
        return tuple(each for each in self._notices if "expression" not in each.context)


# The template's expressions on a rig, which jobs solve once and leave for each other.


def known_basis(
    task: Task[Any], face: Face, shapes: NDArray[np.floating], fraction: float
) -> ExpressionBasis | None:
    """Return the basis that an earlier attempt or an earlier job left, if one did.

    One of another face or of other shapes is none; why is told when ``fraction`` of the job is
    done.
    """
    kept = task.out / BASIS_FILE
    known: Path | None = task.inputs.get("expression_basis")
    if task.resume and kept.is_file():
        known = kept
    try:
        return ExpressionBasis.load(known, face, shapes) if known else None
    except InputError as error:
        if error.code != OTHER:
            raise
        task.progress(Step("warning", fraction, message=f"{error.message}: it is not used"))
        return None


def solve_basis(
    task: Task[Any], face: Face, shapes: NDArray[np.floating], span: JobPart
) -> ExpressionBasis:
    """Return the known basis, else solve it in a ``span`` of the job; it is left for later jobs."""
    basis = known_basis(task, face, shapes, span.start)
    if basis is None:

        def show(part: float) -> None:
            task.progress(Step("expressions", span.at(part)))

        basis = ExpressionBasis.solve(face, shapes, listen=show)
    basis.save(task.out / BASIS_FILE, face)
    return basis
