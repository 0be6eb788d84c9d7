"""The job that fits a take of markers: activations, jaw and head, frame after frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.build import jaw_tracks
from solver.errors import Finding, InputError, make_warning
from solver.fitting import prior
from solver.fitting.calibration import fibre_muscles, load_muscles, with_fibres
from solver.fitting.contraction import Contraction
from solver.fitting.face import Face
from solver.fitting.joints import jaw_on_tracks
from solver.fitting.markers.filter import FilterOptions
from solver.fitting.markers.observation import MarkerOptions, Markers
from solver.fitting.markers.places import RefineOptions, refine_by_take
from solver.fitting.markers.robust import RobustOptions
from solver.fitting.markers.term import MarkerPlaces
from solver.fitting.prior import GaussianPrior
from solver.fitting.strips import strip_names
from solver.fitting.target_checks import check_held
from solver.fitting.tracking.tracker import Tracker
from solver.jobs import Task, hash_files
from solver.jobs.marker_frames import TakeDrawing, TakeFitter, marker_report, smooth_frames
from solver.jobs.sequences import fit_frames, frame_numbers, refuse_unfitted, write_animated
from solver.jobs.templates import read_template
from solver.kinds.fit_markers import FitMarkers
from solver.mechanics.flesh import MOONEY_RIVLIN
from solver.mechanics.jaw_tracks import JawTracks
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.progress import Step
from solver.rig.frames import sequence_report, write_sequence
from solver.rig.marker_view import FILE as VIEW_FILE
from solver.rig.rig import Rig
from solver.scans.markers.actor import carry, off_places
from solver.scans.markers.bind import bind, model_face
from solver.scans.markers.face_take import FACE, count_tracks, frames_about, living_labels
from solver.scans.markers.faults import find_faults
from solver.scans.markers.findings import LIMITS
from solver.scans.markers.marker_set import BoundTake, MarkerSet
from solver.scans.markers.motion import still_seconds
from solver.scans.markers.moved import split_moved
from solver.scans.markers.shape import is_motionless, refuse_flat
from solver.scans.markers.take import Take, read_take


@dataclass(frozen=True)
class FitMarkersOptions:
    """Numbers of the job itself."""

    rate: float = 60.0  # of a take that does not say
    least: int = 4  # markers of the set that the take has to have
    # A file of frames ends where the fit begins anew from what the file holds, so that a resumed
    # job goes the same way: so many frames, fewer of a face of so many tets.
    frames: int = 60
    tets: int = 1_500_000


OPTIONS = FitMarkersOptions()


def run(task: Task[FitMarkers]) -> list[Path]:
    """Fit the frames of a take with the S of ``rig``, each from the one before.

    Frames that are ready are in ``out/frames``; with ``resume`` the fit goes on after them, to the
    same result. Without a marker set the markers are bound to the face by their names and places.
    Raises :class:`InputError` for what cannot be used, ``sequence.nothing`` if no frame could be
    fitted.
    """
    given, out, progress = task.options, task.out, task.progress
    progress(Step("read", 0.0, message=task.inputs["markers"].name))
    rig, take = Rig.load(task.inputs), count_tracks(read_take(task.inputs["markers"]))
    numbers = frame_numbers(take.file, take.numbers, given)
    rate = given.rate or (take.rate if take.rate > 0 else OPTIONS.rate)
    source, carried, notices = _bound(task, take, rig.model, rate)
    face, muscles = _face(task, rig, notices)
    check_held(face)
    progress(Step("read", 0.01, message=f"{len(numbers)} frames of {len(take)}"))
    markers = _markers(task, source, _prior(task, rig, face), face, rate)
    drawing = TakeDrawing(markers, source, muscles)
    done = fit_frames(task, numbers, _fitter(task, markers, source, drawing))
    refuse_unfitted(done, take.file)
    if given.smooth:
        progress(Step("smooth", 0.93))
        drawing = TakeDrawing(markers, source, muscles)
        done = smooth_frames(markers, done, source, drawing.add)
    progress(Step("export", 0.96))
    report = sequence_report(done, rate, take.file)
    report |= marker_report(done, source.labels, notices)
    report |= carried | {"notices": [notice.as_dict() for notice in notices]}
    animated, report["files"] = write_animated(out, drawing.skin, rig.model, rate, take.first)
    view, contraction = out / VIEW_FILE, Contraction.of_face(face)
    report["files"][VIEW_FILE] = drawing.view.write(view, rate)
    files = write_sequence(out, done, muscles, rate, report, contraction, take.first)
    files += [out / "markers.json"] if given.refine and not given.actor else []
    files += [*animated, view]
    progress(Step("done", 1.0))
    return files


def _bound(
    task: Task[FitMarkers], take: Take, model: SubjectModel, rate: float
) -> tuple[BoundTake, dict[str, Any], list[Finding]]:
    """Return the take read by its marker set, what was carried of an actor, and what is odd.

    What stands still or was drawn is missing, labels that are swapped are exchanged. A marker that
    moved is another one from then on.
    """
    given, given_set, skin = task.options, task.inputs.get("marker_set"), model_face(model)
    take = take.pick(living_labels(take).tolist())
    rows, notices = frames_about(take, given.neutral, rate), list[Finding]()
    if given_set is None:
        found = bind(take, model, rows, actor=given.actor)
        markers = found.markers
        notices.extend(found.findings)
        if given.actor:
            rows = found.neutral  # the motions count from the frames whose places they are
    else:
        markers = MarkerSet.load(given_set, model)
    report: dict[str, Any] = {}
    if given.actor:
        carried = carry(take, markers, skin, rate, rows)
        take, markers, report = carried.take, carried.markers, {"actor": carried.report}
        notices.extend(carried.notices)
    faults = find_faults(markers.session.scale * take.positions, rate)
    refuse_flat(take.file, faults.motion.middle)
    if is_motionless(faults.motion):
        message = f"no marker of {take.file} moves against the others: there is no motion to fit"
        notices.append(make_warning("markers.motionless", message))
    if not given.actor:
        motion, spans = faults.motion, [rows] if rows else []
        # people are still in expressions, too
        spans = spans or [each.rows for each in still_seconds(motion, rate, FACE.rest.seconds)]
        off_mm, rows = min((off_places(take, markers, motion, skin, each), each) for each in spans)
        notices.extend(_other_person(take, rows, off_mm))
    positions, exchanged = faults.put_right(faults.hide_unmeasured(take.positions))
    take, markers = split_moved(replace(take, positions=positions), markers, faults, skin)
    return BoundTake(take, markers, OPTIONS.least, exchanged), report, notices


def _other_person(take: Take, rows: tuple[int, int], off_mm: float) -> list[Finding]:
    """Return the warning that a take is another person's, if its markers are so far off at rest."""
    if off_mm <= LIMITS.person:
        return []
    first, last = (take.numbers[row] for row in rows)
    message = (
        f"in frames {first} to {last} the markers of {take.file} are {off_mm:.1f} mm off their "
        "places: the face is not at rest there (neutral), or another person's (actor)"
    )
    figures = {"frames": [first, last], "found": round(off_mm, 2), "expected": LIMITS.person}
    return [make_warning("markers.other_person", message, figures)]


def _face(task: Task[FitMarkers], rig: Rig, notices: list[Finding]) -> tuple[Face, tuple[str, ...]]:
    """Return the face that frames are fitted with, and its muscles' names; adds what is odd."""
    given, model = task.options, rig.model
    names = tuple(model.muscle_names)
    if given.muscles == "fibre":
        face = Face(model, material=MOONEY_RIVLIN, linear=given.linear_solver)
        known = task.inputs.get("fibre_muscles")
        if known is None:
            words = "the fibre muscles are not calibrated: much of an expression is beyond them"
            notices.append(make_warning("fibres.uncalibrated", words))
        muscles = fibre_muscles(face) if known is None else load_muscles(known, face)
        face, names = with_fibres(face, muscles), strip_names(names, muscles)
    else:
        face = rig.face(given.linear_solver or fastest())
    if given.jaw == "tracks":
        tracks = JawTracks.of(model.jaw) or jaw_tracks(read_template(task), model)
        face = face.with_joint(jaw_on_tracks(tracks))
    return face, names


def _markers(
    task: Task[FitMarkers], source: BoundTake, known: GaussianPrior, face: Face, rate: float
) -> Markers:
    """Return the markers of the take, their places mended if that was asked for."""
    given, used, usual = task.options, source.markers, MarkerOptions().tracking
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
        used = refine_by_take(
            face, used, known, source.points, source.frames, 1.0 / rate, given.refine, mending
        )
        source.save(used, task.out / "markers.json")
    sigma = np.array([marker.sigma_mm for marker in used])
    places = MarkerPlaces(face.model, used)
    return Markers(face, places, sigma, known, given.step / rate, options)


def _fitter(
    task: Task[FitMarkers], markers: Markers, source: BoundTake, drawing: TakeDrawing
) -> TakeFitter:
    about = {
        "options": task.options.model_dump(mode="json", exclude={"end"}),
        "files": hash_files(task.inputs),
    }
    frames = int(np.clip(OPTIONS.tets // len(markers.face.model.tets), 1, OPTIONS.frames))
    return TakeFitter(Tracker(markers), source, drawing, about, frames)


def _prior(task: Task[FitMarkers], rig: Rig, face: Face) -> GaussianPrior:
    """Return the prior that was asked for; raises ``markers.prior`` where there is none."""
    given, layout = task.options, face.layout
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

    def show(done: float) -> None:
        task.progress(Step("expressions", 0.01 * done))

    return prior.from_fitted_shapes(face, shapes.expressions, listen=show)
