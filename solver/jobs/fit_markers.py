"""The job that fits a take of markers: activations, jaw and head, frame after frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from solver.anatomy.build import jaw_tracks
from solver.errors import Finding, InputError, make_warning
from solver.fitting import prior
from solver.fitting.calibration import fibre_muscles, load_muscles, with_fibres
from solver.fitting.contraction import Contraction
from solver.fitting.controls import jaw_on_tracks
from solver.fitting.expression_basis import FILE as BASIS_FILE
from solver.fitting.expression_basis import ExpressionBasis
from solver.fitting.face import Face
from solver.fitting.known import FaceMuscles
from solver.fitting.markers.filter import FilterOptions
from solver.fitting.markers.observation import MarkerOptions, Markers
from solver.fitting.markers.places import RefineOptions, refine_by_take
from solver.fitting.markers.robust import RobustOptions
from solver.fitting.markers.term import MarkerPlaces
from solver.fitting.prior import GaussianPrior
from solver.fitting.strips import strip_names
from solver.fitting.target_checks import check_held
from solver.fitting.tracking import Tracker
from solver.jobs import Task, read_template
from solver.jobs.fits import JobPart, solve_basis
from solver.jobs.live_off import LiveOff
from solver.jobs.marker_frames import (
    VIEW_FILE,
    TakeDrawing,
    TakeFitter,
    marker_report,
    smooth_frames,
)
from solver.jobs.sequences import KnownFrames, fit_frames, frame_numbers, write_animated
from solver.kinds.fit_markers import FitMarkers
from solver.mechanics.flesh import MOONEY_RIVLIN
from solver.mechanics.jaw_tracks import JawTracks
from solver.mechanics.linear import fastest
from solver.progress import Step
from solver.rig import Rig
from solver.rig.frames import sequence_report, write_sequence
from solver.scans.markers.places.bind import Reference
from solver.scans.markers.places.face_take import USUAL_RATE, count_tracks, frames_about
from solver.scans.markers.places.marker_set import BoundTake
from solver.scans.markers.prepare import PreparedTake, PrepareOptions
from solver.scans.markers.readers.take import read_take
from solver.storage import hash_files


@dataclass(frozen=True)
class FitMarkersOptions:
    """Numbers of the job itself."""

    # A file of frames ends where the fit begins anew from what the file holds, so that a resumed
    # job goes the same way: so many frames, fewer of a face of so many tets.
    frames: int = 60
    tets: int = 1_500_000


OPTIONS = FitMarkersOptions()
EXPRESSIONS = JobPart(0.0, 0.01)  # of the job, for the template's expressions


def run(task: Task[FitMarkers]) -> list[Path]:
    """Fit the frames of a take with the S of ``rig``, each from the one before.

    Frames that are ready are in ``out/frames``; with ``resume`` the fit goes on after them, to the
    same result. Without a marker set the markers are bound to the face by their names and places.
    Raises :class:`InputError` for what cannot be used, ``sequence.nothing`` if no frame could be
    fitted.
    """
    given = task.options
    out = task.out
    progress = task.progress
    progress(Step("read", 0.0, message=task.inputs["markers"].name))
    rig = Rig.load(task.inputs)
    take = count_tracks(read_take(task.inputs["markers"]))
    live = LiveOff(task, rig, task.inputs["markers"], take.first)
    numbers = frame_numbers(take.file, take.numbers, given)
    rate = given.rate or (take.rate if take.rate > 0 else USUAL_RATE)
    options = PrepareOptions(given.actor, frames_about(take, given.neutral, rate), rate)
    mended = PreparedTake(take, Reference.given(rig.model, task.inputs), options).mended_take
    source = mended.source
    notices = mended.notices
    face, muscles = _face(task, rig, notices)
    check_held(face)
    known = KnownFrames(task, FaceMuscles(face, muscles), take.numbers, rate)
    progress(Step("read", 0.01, message=f"{len(numbers)} frames of {len(take)}"))
    markers = _markers(task, source, _prior(task, rig, face), face, rate)
    drawing = TakeDrawing(markers, source, muscles)
    fitter = _fitter(task, markers, source, drawing, known)
    done = fit_frames(task, numbers, fitter, take.file)
    if given.smooth:
        progress(Step("smooth", 0.93))
        drawing = TakeDrawing(markers, source, muscles)
        done = smooth_frames(markers, done, source, known, drawing.add)
    progress(Step("export", 0.96))
    figures, disagreements = known.report(done)
    notices += disagreements
    report = sequence_report(done, rate, take.file) | figures
    report |= marker_report(done, source.labels, notices) | live.report(drawing.skin.solved())
    report |= mended.carried | {"notices": [notice.as_dict() for notice in notices]}
    animated, report["files"] = write_animated(out, drawing.skin, rig.model, rate, take.first)
    view = out / VIEW_FILE
    contraction = Contraction.of_face(face)
    report["files"][VIEW_FILE] = drawing.view.write(view, rate)
    files = write_sequence(out, done, muscles, rate, report, contraction, take.first)
    files += [out / "markers.json"] if given.refine and not given.actor else []
    files += [out / BASIS_FILE] if (out / BASIS_FILE).is_file() else []
    files += [*animated, view]
    progress(Step("done", 1.0))
    return files


def _face(task: Task[FitMarkers], rig: Rig, notices: list[Finding]) -> tuple[Face, tuple[str, ...]]:
    """Return the face that frames are fitted with, and its muscles' names; adds what is odd."""
    given = task.options
    model = rig.model
    names = tuple(model.muscle_names)
    if given.muscles == "fibre":
        face = Face(model, material=MOONEY_RIVLIN, linear=given.linear_solver)
        known = task.inputs.get("fibre_muscles")
        if known is None:
            words = "the fibre muscles are not calibrated: much of an expression is beyond them"
            notices.append(make_warning("fibres.uncalibrated", words))
        muscles = fibre_muscles(face) if known is None else load_muscles(known, face)
        face = with_fibres(face, muscles)
        names = strip_names(names, muscles)
    else:
        face = rig.face(given.linear_solver or fastest())
    if given.jaw == "tracks":
        tracks = JawTracks.of(model.jaw) or jaw_tracks(read_template(task), model)
        face = face.with_joint(jaw_on_tracks(tracks))
    elif given.jaw == "free":
        face = face.with_free_jaw()
    return face, names


def _markers(
    task: Task[FitMarkers], source: BoundTake, known: GaussianPrior, face: Face, rate: float
) -> Markers:
    """Return the markers of the take, their places mended if that was asked for."""
    given = task.options
    used = source.markers
    usual = MarkerOptions().tracking
    options = MarkerOptions(
        filter=FilterOptions(forgetting=given.temporal),
        hold_below=given.hold_below,
        noise_mm=given.sigma_mm,
        tracking=replace(usual, whole=replace(usual.whole, max_iterations=given.max_iterations)),
        robust=RobustOptions(scale_mm=given.robust_mm),
    )
    if given.refine and not given.actor:  # a carried neutral lies on the places
        task.progress(Step("places", 0.01))
        # of the whole take: places must not depend on where the fit ends
        mending = RefineOptions(tracking=options)
        seconds = 1.0 / rate
        used = refine_by_take(
            face,
            used,
            known,
            lambda number: source.frame(number).points,
            source.frames,
            seconds,
            given.refine,
            mending,
        )
        source.save(used, task.out / "markers.json")
    sigma = np.array([marker.sigma_mm for marker in used])
    places = MarkerPlaces(face.model, used)
    return Markers(face, places, sigma, known, given.step / rate, options)


def _fitter(
    task: Task[FitMarkers],
    markers: Markers,
    source: BoundTake,
    drawing: TakeDrawing,
    known: KnownFrames,
) -> TakeFitter:
    about = {
        "options": task.options.model_dump(mode="json", exclude={"end"}),
        "files": hash_files(task.inputs),
    }
    frames = int(np.clip(OPTIONS.tets // len(markers.face.model.tets), 1, OPTIONS.frames))
    return TakeFitter(Tracker(markers), source, drawing, about, frames, known)


def _prior(task: Task[FitMarkers], rig: Rig, face: Face) -> GaussianPrior:
    """Return the prior that was asked for; raises ``markers.prior`` where there is none."""
    given = task.options
    layout = face.layout
    kind = given.prior
    if kind == "none":
        return prior.from_changes(layout, [], prior.LOOSE)
    if kind == "scans":
        good = [each for each in rig.expressions if each.status != "failed"]
        if not good or given.muscles == "fibre":
            message = "the rig has no expressions of such muscles to make a prior from"
            raise InputError("markers.prior", message)
        return prior.from_expressions(
            face, [face.pose_of(each.activations, each.jaw) for each in good]
        )
    shapes = read_template(task).shapes
    if shapes is None or shapes.expressions.shape[1] != len(face.model.skin.vertices):
        message = "the template has no expressions of this skin: use the prior scans or none"
        raise InputError("markers.prior", message)

    return prior.from_basis(face, _basis(task, face, shapes.expressions))


def _basis(task: Task[FitMarkers], face: Face, shapes: NDArray[np.floating]) -> ExpressionBasis:
    """Return the template's expressions on a face, those that an earlier job solved if there are.

    They are left for the next; not those of fibre muscles, which are no rig's.
    """
    if task.options.muscles == "fibre":

        def show(done: float) -> None:
            task.progress(Step("expressions", EXPRESSIONS.at(done)))

        return ExpressionBasis.solve(face, shapes, listen=show)
    return solve_basis(task, face, shapes, EXPRESSIONS)
