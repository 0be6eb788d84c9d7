"""The job that fits weights of muscle tracks, and systems beside them, to scans."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.errors import Finding, make_warning
from solver.fitting.face import Face
from solver.fitting.least_squares import Listener
from solver.fitting.objective import Target
from solver.fitting.target_checks import before_fit, check_held
from solver.fitting.tracking.dense import HeadAndFace, stillness
from solver.jobs import Task, fits
from solver.kinds.fit_tracks import FitTracks
from solver.mechanics.linear import fastest
from solver.meshio.registered import RegisteredScan
from solver.model import SubjectModel
from solver.progress import Step, part_of
from solver.rig import Rig, ShapeFit, ShapeSystem, System, TetSystem
from solver.rig.report import known_information
from solver.rig.report.systems import SYSTEMS
from solver.rig.shape_fits import SCAN_HEAD, find_crossed, fit_scan
from solver.rig.tet_fits import TetFitter
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.fit import ShapeFace, State, TrackFitOptions
from solver.tracks.plain import PlainFace

BOUNDS = {"unit": (0.0, 1.0), "free": (-np.inf, np.inf)}


def run(task: Task[FitTracks]) -> list[Path]:
    """Fit scans by tracks, and by other systems if asked for; write the new rig's files.

    The rig's expressions are carried over in all systems; a new capture of the same name replaces
    the old. Raises :class:`~solver.errors.InputError`: ``tracks.*``, ``scan.*``, ``rig.*``.
    """
    given = task.options
    progress = task.progress
    progress(Step("read", 0.0, message=f"{len(task.captures)} scans"))
    rig = Rig.load(task.inputs)
    model = rig.model
    linear = given.linear_solver or fastest()
    scans = fits.read_scans(model, task.captures)
    tracks = MuscleTracks.load(task.inputs["tracks"], model)
    face = rig.face(linear)
    check_held(face)
    log = fits.WarningLog(model, progress)
    odd = before_fit(model, scans, is_head_placed=given.head == "placed")
    log.warn(0.02, [*odd, *([] if given.muscles else _other_scans(rig, scans))])
    parent = rig
    seconds = dict(rig.seconds)
    made = fits.Targets(model, given.distance)
    targets = made.of_scans(scans)
    still = stillness(face) if given.head == "placed" else None
    points = HeadAndFace(made.of_points, still, SCAN_HEAD)
    if given.muscles:
        begin = time.perf_counter()
        rig = _with_muscles(rig, face, scans, targets, log.branch())
        seconds["activations"] = time.perf_counter() - begin
    faces: dict[str, ShapeFace[Any]] = {
        "T": TrackFace(model, tracks, track_potentials(model), linear=linear)
    }
    if given.plain_shapes:
        faces["B"] = PlainFace(model, tracks)
    systems = fits.carried_systems(rig, scans)
    parts = [*faces, "P"] if given.per_tet else [*faces]
    for number, letter in enumerate(parts):
        begin = time.perf_counter()
        span = fits.JobPart(0.2, 0.5).part(number, len(parts))
        about = _Fitting(scans, targets, points, given, log.branch(), span)
        found: System
        found = about.of_tets(model) if letter == "P" else about.of_shapes(faces[letter], letter)
        systems[letter] = systems[letter].replaced(found) if letter in systems else found
        seconds[SYSTEMS[letter]] = time.perf_counter() - begin
    options = given.model_dump(exclude={"linear_solver"})
    settings = {**(rig.figures or {}).get("settings", {}), "tracks": options}
    whole = replace(rig, seconds=seconds, notices=log.general, systems=systems)
    information = (
        known_information(parent) if _training_names(rig) == _training_names(parent) else None
    )
    ending = part_of(progress, 0.5)
    return fits.leave_rig(face, whole, settings, task.out, ending, information)


def _training_names(rig: Rig) -> list[str]:
    """Return the names of the expressions that S was fitted to."""
    return [fit.name for fit in rig.expressions if fit.role == "train"]


def _other_scans(rig: Rig, scans: Mapping[str, RegisteredScan]) -> list[Finding]:
    """Return the expressions that muscles were fitted to by other scans than these."""
    found = []
    for fit in rig.expressions:
        if fit.name in scans and not fit.is_of(scans[fit.name].vertices):
            message = (
                f"{fit.name}: the rig's muscles are fitted to another scan of that name: fit them "
                "to this one, too, to compare"
            )
            found.append(make_warning("target.other", message, {"expression": fit.name}))
    return found


def _with_muscles(
    rig: Rig,
    face: Face,
    scans: Mapping[str, RegisteredScan],
    targets: Mapping[str, Target],
    log: fits.WarningLog,
) -> Rig:
    """Return the rig with its muscles fitted to those of the scans that they were not yet."""
    known = {
        fit.name
        for fit in rig.expressions
        if fit.name in scans and fit.is_of(scans[fit.name].vertices)
    }
    missing = {name: scan for name, scan in scans.items() if name not in known}
    if not missing:
        return rig
    wanted = {name: targets[name] for name in missing}
    fitted = fits.fit_unseen(face, missing, wanted, log, fits.JobPart(0.02, 0.2))
    kept = [fit for fit in rig.expressions if fit.name not in missing]
    return replace(rig, expressions=(*kept, *fitted))


@dataclass(frozen=True)
class _Fitting:
    """What fits of any system's controls have in common; ``span`` is their part of the job."""

    scans: Mapping[str, RegisteredScan]
    targets: Mapping[str, Target]
    points: HeadAndFace  # that makes targets for weights
    given: FitTracks
    log: fits.WarningLog
    span: fits.JobPart

    def of_shapes(self, driven: ShapeFace[State], letter: str) -> ShapeSystem:
        """Fit weights and jaw to every scan; ``letter`` is that of the system."""
        given = self.given
        options = TrackFitOptions(given.w_w, given.w_j, BOUNDS[given.bounds])
        options = replace(options, stop=replace(options.stop, iterations=given.max_iterations))

        def fit(name: str, scan: RegisteredScan, listen: Listener) -> ShapeFit:
            found = fit_scan(driven, name, scan, self.points, options, listen)
            crossed = find_crossed(driven.face.model, found)
            return replace(found, notices=(*found.notices, *crossed))

        return ShapeSystem(self._each(letter, fit, given.max_iterations), driven.tracks.names)

    def of_tets(self, model: SubjectModel) -> TetSystem:
        """Fit activations of single tets and the jaw to every scan."""
        fitter = TetFitter(model, self.targets, self.given.linear_solver or fastest())
        fitted = self._each("P", fitter.fit, fitter.options.max_iterations)
        return TetSystem(fitted, fitter.tets)

    def _each(
        self, letter: str, fit: Callable[[str, RegisteredScan, Listener], fits.Fit], most: int
    ) -> tuple[fits.Fit, ...]:
        """Fit every scan by a system's controls, in ``most`` iterations at most, and tell it."""
        phase = SYSTEMS[letter].replace(" ", "_")
        fitted = []
        for number, (name, scan) in enumerate(self.scans.items()):
            part = self.span.part(number, len(self.scans))
            found = fit(name, scan, self.log.listener(phase, name, part, most))
            fitted.append(self.log.about(found, part.end, found.notices))
        fits.refuse_failures(fitted)
        return tuple(fitted)
