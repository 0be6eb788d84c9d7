"""The job that fits weights of muscle tracks, a jaw and cameras to photographs."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.skin_points import SkinPoints
from solver.errors import Finding, InputError, SolveError, make_warning, quote_names
from solver.fitting.least_squares import Listener
from solver.fitting.target_checks import check_held
from solver.jobs import Task, fits, read_template
from solver.jobs.films import fit_film
from solver.jobs.photos import read_faces
from solver.kinds.fit_photo import FitPhoto
from solver.mechanics.boundary import JAW_FREEDOM
from solver.mechanics.linear import fastest
from solver.photo.archive import FILE as PHOTO_FILE
from solver.photo.archive import photo_archive
from solver.photo.compared import find_unexplained
from solver.photo.expression import (
    ExpressionOptions,
    PhotoExpression,
    ShadingOptions,
    fit_expression,
    read_neutral,
)
from solver.photo.film import FilmOptions
from solver.photo.fit import PhotoFitOptions
from solver.photo.light import Appearance
from solver.photo.mesh_points import landmark_points
from solver.photo.oddities import find_closed_eyes
from solver.photo.other_person import find_other_person, somebody_else
from solver.photo.photo import Photo
from solver.photo.placed import Reprojection, find_contradiction, reprojections
from solver.photo.report import photo_figures, photo_picture, seen_faces
from solver.progress import Step, part_of
from solver.rig import Rig, ShapeFit, ShapeSystem
from solver.rig.report import known_information
from solver.rig.report.systems import SYSTEMS
from solver.storage import write_json
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.fit import ShapeFace, State, TrackFitOptions
from solver.tracks.plain import PlainFace

LETTERS = {"tracks": "T", "shapes": "B"}


def run(task: Task[FitPhoto]) -> list[Path]:
    """Fit every moment's photographs; write the new rig's files, cameras and pictures.

    Of a film it writes what sequences leave (:func:`~solver.jobs.films.fit_film`). Raises
    :class:`~solver.errors.InputError`: ``photo.*``, ``film.*``, ``tracks.*``, ``rig.*``,
    ``landmarks.*`` where they have to be found.
    """
    given = task.options
    progress = task.progress
    if "film" in task.inputs and not given.sequence:
        raise InputError(
            "options.sequence", "a film is given, which is fitted by sequence: ask for it"
        )
    what = "a film" if given.sequence else f"{len(task.captures)} photographs"
    progress(Step("read", 0.0, message=what))
    template = read_template(task)
    rig = fits.read_rig_or_model(task)
    model = rig.model
    linear = given.linear_solver or fastest()
    tracks = MuscleTracks.load(task.inputs["tracks"], model)
    if given.sequence:
        face = rig.face(linear)
        check_held(face)
        driven = _face(given, rig, tracks, linear)
        film = FilmOptions(_options(given))
        steps = min(film.stop.iterations, given.max_iterations)
        film = replace(film, stop=replace(film.stop, iterations=steps))
        return fit_film(task, driven, face, template, film)
    photos, findings = read_faces(task, template, given.boxes)
    moments = _moments(given, photos)
    points = landmark_points(template)
    others = somebody_else(template, model.skin.vertices, photos, points)
    for name, nats in others.nats.items():
        findings[name] += find_other_person(name, nats, "the person of the model")
    face = rig.face(linear)
    check_held(face)
    letter = LETTERS[given.model]
    driven = _face(given, rig, tracks, linear)
    log = fits.WarningLog(model, progress)
    begun = time.perf_counter()
    fitter = _Fitter(driven, points, _options(given))
    lights: dict[str, Appearance] = {}
    if given.neutral:
        findings[given.neutral] += find_closed_eyes(given.neutral, photos[given.neutral].landmarks)
        look = read_neutral(driven, photos[given.neutral], points, fitter.options)
        points = look.points
        fitter = replace(fitter, points=look.points)
        lights = dict.fromkeys(photos, look.appearance) if look.appearance else {}
    fitted = []
    shown = {}
    for number, (name, taken) in enumerate(moments.items()):
        part = fits.JobPart(0.1, 0.5).part(number, len(moments))
        listen = log.listener(SYSTEMS[letter].replace(" ", "_"), name, part, given.max_iterations)
        found = fitter.fit(name, [photos[each] for each in taken], lights, listen)
        compared = () if found.result is None else found.result.compared
        for photo, skin in zip(taken, compared, strict=False):  # nothing without shading
            findings[photo] += find_unexplained(photo, skin)
        noticed = [each for photo in taken for each in findings[photo]]
        fitted.append(log.about(found.shape, part.end, [*found.shape.notices, *noticed]))
        shown[name] = found
    fits.refuse_failures(fitted)
    scans = {fit.name: fit.target for fit in fitted}
    systems = {name: system.without(scans) for name, system in rig.systems.items()}
    made = ShapeSystem(tuple(fitted), tracks.names)
    systems[letter] = systems[letter].replaced(made) if letter in systems else made
    seconds = {**rig.seconds, SYSTEMS[letter]: time.perf_counter() - begun}
    whole = replace(rig, seconds=seconds, notices=log.general, systems=systems)
    settings = {
        **(rig.figures or {}).get("settings", {}),
        "photo": given.model_dump(exclude={"linear_solver"}),
    }
    results = {name: each.result for name, each in shown.items() if each.result is not None}
    taken_at = {name: [photos[each] for each in taken] for name, taken in moments.items()}
    figures = {
        name: photo_figures(taken_at[name], result, points, shown[name].placed, others)
        for name, result in results.items()
    }
    own = [task.out / name for name in ("photo.json", "photo.png", PHOTO_FILE)]
    notices = [each.as_dict() for found in findings.values() for each in found]
    write_json(own[0], {"model": given.model, "notices": notices, "expressions": figures})
    seen = [each for name, result in results.items() for each in seen_faces(taken_at[name], result)]
    photo_picture(model, seen, points, own[1])
    photo_archive(model, taken_at, results, fitter.options.fit.loss).write(own[2])
    ending = part_of(progress, 0.5)
    information = known_information(rig)
    files = fits.leave_rig(face, whole, settings, task.out, ending, information)
    return [*files, *own]


def _moments(given: FitPhoto, photos: Mapping[str, Photo]) -> dict[str, list[str]]:
    """Return the names of each moment's photographs by the expression they show."""
    known = quote_names(sorted(photos))
    seen = set[str]()
    for name, taken in given.moments.items():
        for each in taken:
            if each not in photos:
                message = f"options.moments.{name}: there is no photograph {each!r}: {known} are"
                raise InputError("photo.moment", message, expression=name, photo=each)
            if each in seen:
                message = f"options.moments: {each!r} is named twice, and shows one moment"
                raise InputError("photo.moment", message, expression=name, photo=each)
            seen.add(each)
    alone = {name: [name] for name in photos if name not in seen}
    for name in given.moments.keys() & alone.keys():
        message = (
            f"options.moments.{name}: a photograph that is in no moment is called {name!r} too: "
            "give the moment another name, or that photograph to one"
        )
        raise InputError("photo.moment", message, expression=name, photo=name)
    if given.neutral and given.neutral not in photos:
        message = f"options.neutral: there is no photograph {given.neutral!r}: {known} are"
        raise InputError("photo.neutral", message, photo=given.neutral)
    return {name: list(taken) for name, taken in {**given.moments, **alone}.items()}


def _face(given: FitPhoto, rig: Rig, tracks: MuscleTracks, linear: str) -> ShapeFace[Any]:
    if given.model == "shapes":
        return PlainFace(rig.model, tracks)
    return TrackFace(rig.model, tracks, track_potentials(rig.model), linear=linear)


def _options(given: FitPhoto) -> ExpressionOptions:
    controls = TrackFitOptions(w_w=given.w_w, w_j=given.w_j)
    fit = PhotoFitOptions(controls=controls, w_l=given.w_l)
    fit = replace(fit, stop=replace(fit.stop, iterations=given.max_iterations))
    return ExpressionOptions(fit=fit, shading=ShadingOptions() if given.by_shading else None)


@dataclass(frozen=True)
class _Fitted:
    """An expression for the rig, and what it is made of; None where nothing was found."""

    shape: ShapeFit
    result: PhotoExpression[Any] | None
    placed: Mapping[str, Reprojection] = field(default_factory=dict)


@dataclass(frozen=True)
class _Fitter:
    face: ShapeFace[Any]
    points: SkinPoints
    options: ExpressionOptions

    def fit(
        self, name: str, photos: list[Photo], lights: Mapping[str, Appearance], listen: Listener
    ) -> _Fitted:
        """Fit the photographs of one moment; at rest, and told, where the flesh finds no way."""
        begun = time.perf_counter()
        try:
            found = fit_expression(
                self.face, photos, self.points, None, self.options, lights, listen
            )
        except (SolveError, np.linalg.LinAlgError) as error:
            notices = (make_warning("solve.failed", f"no fit was found ({error})"),)
            shape = self._shape(name, self.face.rest(), notices)
            return _Fitted(replace(shape, status="failed"), None)
        end = found.landmarks.point
        placed = reprojections(self.face, photos, self.points, end, self.options)
        told = tuple(find_contradiction(placed))
        shape = self._shape(name, found.fit.point.state, told)
        seconds = time.perf_counter() - begun
        taken = tuple(photo.name for photo in photos)
        shape = replace(shape, seconds=seconds, iterations=found.steps, photos=taken)
        return _Fitted(shape, found, placed)

    def _shape(self, name: str, state: State, notices: tuple[Finding, ...]) -> ShapeFit:
        """Return an expression without a scan: its target is nowhere."""
        skin = self.face.skin(state)
        nowhere = np.full_like(skin, np.nan)
        return ShapeFit(
            name,
            "test",
            state.pose.activations,
            state.pose.jaw,
            skin,
            nowhere,
            nowhere[:, 0].copy(),
            state.inverted,
            0,
            0.0,
            0.0,
            state.x,
            confidence=np.zeros(len(skin)),
            notices=notices,
            weights=state.q[:-JAW_FREEDOM],
            jaw_on_top=state.q[-JAW_FREEDOM:],
            lengths=state.pose.lengths,
        )
