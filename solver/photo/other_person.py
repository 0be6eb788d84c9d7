"""Whether a photograph shows somebody else than the person whose face is fitted to it.

    b = argmin min over w, c    1/2 |I b + E w + C c + r|^2 + 1/2 b . P b + |w|^2 / (2 s^2)
    nats = 1/2 d . (own^-1 - others^-1) d + 1/2 log(det own / det others),    d = U b - mean

r are the landmarks of the photograph off the known person's face with their expression taken out,
in units of noise; I, E and C their derivatives by identity shapes, expressions and the camera: b is
what identity shapes would still change. It is not 0 for the person themselves, as a detector errs
alike in all pictures of one person and errs more in strong expressions. So how it is distributed
was learned from drawn people, by their own face (``own``) and by somebody else's (``others``), in
the combinations U of identity shapes that landmarks tell most of (a quadratic discriminant).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg

from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Template
from solver.errors import Finding, InputError, make_warning
from solver.photo.camera import POSE_FREEDOM
from solver.photo.expression import ExpressionOptions
from solver.photo.fit import PhotoFitOptions
from solver.photo.identity import PersonShapes, see_person
from solver.photo.photo import Photo
from solver.storage import Archive, Arrays, read_arrays
from solver.surface import Floats, Surface
from solver.templates.builtin.build import POINTS_FILE
from solver.tracks.fit import TrackFitOptions

# of the built-in face's points, written by scripts/builtin_people.py
PEOPLE_FILE = POINTS_FILE.with_name("people.npz")
UNKNOWN = "how the detector errs on this template's people was not learned"


@dataclass(frozen=True)
class PersonOptions:
    """What is compared of a person and a photograph, and from where on it is told."""

    views: ExpressionOptions = field(
        default_factory=lambda: ExpressionOptions(
            fit=PhotoFitOptions(controls=TrackFitOptions(w_w=0.5), w_l=3.0)
        )
    )
    # standard deviations of what else explains landmarks: weights of expressions, turns of the
    # head in rad and its shifts in mm, which are free, and the focal length's logarithm
    expression: float = 0.15
    turn: float = 10.0
    shift_mm: float = 1e4
    focal: float = 0.35
    # a photograph with fewer of the detector's points, or a smaller face, is not judged
    least_points: int = 250
    eyes_px: float = 60.0
    warn_nats: float = 4.0  # log of how much likelier somebody else is by the landmarks


PERSON_OPTIONS = PersonOptions()


@dataclass(frozen=True)
class PersonShift:
    """What identity shapes would change of a face to explain a photograph's landmarks."""

    b: Floats  # (n,) in standard deviations among people
    information: Floats  # (n, n) of landmarks about it


@dataclass(frozen=True)
class JudgedPicture:
    """A picture of a ``person``, by their own face and by that of another."""

    person: int
    other: int
    by_own: PersonShift
    by_other: PersonShift


@dataclass(frozen=True)
class Moments:
    """Second moments (m, m) of what is the same person's and of what is two people's."""

    own: Floats
    others: Floats

    @classmethod
    def of(cls, own: Floats, others: Floats, diagonal: float) -> Moments:
        """Estimate moments from rows (k, m), of which the part ``diagonal`` is not correlated."""
        found = [each.T @ each / len(each) for each in (own, others)]
        return cls(*((1.0 - diagonal) * each + diagonal * np.diag(np.diag(each)) for each in found))

    def nats(self, away: Floats) -> float:
        """Return the log of how much likelier (m,) is of two people."""
        value = 0.0
        for moment, sign in ((self.own, 1.0), (self.others, -1.0)):
            factor = scipy.linalg.cho_factor(moment, lower=True)
            value += sign * 0.5 * float(away @ scipy.linalg.cho_solve(factor, away))
            value += sign * float(np.log(np.diag(factor[0])).sum())
        return value


@dataclass(frozen=True)
class DrawnPeople:
    """How :class:`PersonShift` is distributed in pictures of drawn people.

    It holds for the points of one template, whose arrays have the sha256 ``points``.
    """

    points: str
    modes: Floats  # (m, n) U
    mean: Floats  # (m,) of U b by a person's own face
    shifts: Moments  # of U b about it, by a person's own face and by somebody else's
    pairs: Moments  # of the differences of two pictures, of one person and of two

    @classmethod
    def of(cls, template: Template, path: Path = PEOPLE_FILE) -> DrawnPeople | None:
        """Return what was learned of a template; None where nothing was."""
        if template.points is None or template.shapes is None:
            return None
        found = cls.load(path)
        if found.points != points_sha256(template.points):
            return None
        return found if found.modes.shape[1] == len(template.shapes.identity) else None

    @classmethod
    def learn(
        cls,
        points: SkinPoints,
        prior: Floats,
        pictures: Sequence[JudgedPicture],
        modes: int = 20,
        diagonal: float = 0.1,
    ) -> DrawnPeople:
        """Learn from pictures in which several of each person are.

        ``prior`` (n, n) is P, ``modes`` how many combinations count, and ``diagonal`` the part of
        moments by which they are taken for independent.
        """
        root = scipy.linalg.cholesky(np.linalg.inv(prior), lower=True)
        information = np.mean([each.by_own.information for each in pictures], axis=0)
        axes = np.linalg.eigh(root.T @ information @ root)[1][:, ::-1][:, :modes]
        to_modes = axes.T @ np.linalg.inv(root)
        own = np.array([to_modes @ each.by_own.b for each in pictures])
        other = np.array([to_modes @ each.by_other.b for each in pictures])
        mean = own.mean(axis=0)
        person = np.array([each.person for each in pictures])
        first, second = np.nonzero(np.triu(person[:, None] == person, 1))
        # both by the face of the second
        stranger, owner = np.nonzero(np.array([[each.other] for each in pictures]) == person)
        return cls(
            points_sha256(points),
            to_modes,
            mean,
            Moments.of(own - mean, other - mean, diagonal),
            Moments.of(own[first] - own[second], other[stranger] - own[owner], diagonal),
        )

    def another(self, b: Floats) -> float:
        """Return by how many nats b (n,) is likelier by somebody else's face than by one's own."""
        return self.shifts.nats(self.modes @ b - self.mean)

    def apart(self, shifts: Sequence[Floats]) -> list[float]:
        """Return by how many nats each picture is likelier of another person than the rest are.

        They are the lower medians over the pairs that it is one of, so that one stranger makes
        none of the others suspect; ``shifts`` are b (n,) of two or more pictures by one face.
        """
        away = np.array(shifts) @ self.modes.T
        found = []
        for row, one in enumerate(away):
            nats = sorted(self.pairs.nats(one - other) for other in np.delete(away, row, axis=0))
            found.append(nats[(len(nats) - 1) // 2])
        return found

    def save(self, path: Path) -> None:
        """Write what was learned, in single precision."""
        arrays: Arrays = {
            "modes": self.modes,
            "mean": self.mean,
            "shifts": np.array([self.shifts.own, self.shifts.others]),
            "pairs": np.array([self.pairs.own, self.pairs.others]),
        }
        single = {name: array.astype(np.float32) for name, array in arrays.items()}
        np.savez_compressed(path, allow_pickle=False, points=np.array(self.points), **single)

    @classmethod
    def load(cls, path: Path) -> DrawnPeople:
        """Read what :meth:`save` wrote."""
        arrays = read_arrays(path)
        shifts, pairs = (Moments(*arrays[name].astype(np.float64)) for name in ("shifts", "pairs"))
        modes, mean = (arrays[name].astype(np.float64) for name in ("modes", "mean"))
        return cls(str(arrays["points"]), modes, mean, shifts, pairs)


def points_sha256(points: SkinPoints) -> str:
    """Return the hash of a template's points, which a detector's errors belong to."""
    return Archive({}, points.arrays()).sha256


@dataclass(frozen=True)
class JudgedPhotos:
    """By how many nats photographs are likelier of somebody else, and why others are not judged."""

    nats: Mapping[str, float]
    unjudged: Mapping[str, str]

    def figures(self, name: str) -> dict[str, Any]:
        """Return what is told of a photograph as JSON values."""
        if name in self.nats:
            return {"somebody_else_nats": round(self.nats[name], 2)}
        return {"other_person": f"not judged: {self.unjudged[name]}"}


def somebody_else(
    template: Template,
    neutral: Floats,
    photos: Mapping[str, Photo],
    points: SkinPoints,
    options: PersonOptions = PERSON_OPTIONS,
) -> JudgedPhotos:
    """Return by how many nats somebody else than a person is likelier in photographs.

    ``neutral`` (V, 3) is the person's face at rest, in the template's topology.
    """
    people = DrawnPeople.of(template)
    if people is None:
        return JudgedPhotos({}, dict.fromkeys(photos, UNKNOWN))
    if neutral.shape != template.skin.vertices.shape:
        reason = "the model's skin is not that of the template"
        return JudgedPhotos({}, dict.fromkeys(photos, reason))
    shifts, unjudged = _shifts(template, neutral, photos, points, options)
    return JudgedPhotos({name: people.another(b) for name, b in shifts.items()}, unjudged)


def not_as_the_rest(
    template: Template,
    photos: Mapping[str, Photo],
    points: SkinPoints,
    options: PersonOptions = PERSON_OPTIONS,
) -> JudgedPhotos:
    """Return by how many nats photographs are likelier of another person than the rest.

    Nothing is known of the person.
    """
    people = DrawnPeople.of(template)
    if people is None:
        return JudgedPhotos({}, dict.fromkeys(photos, UNKNOWN))
    shifts, unjudged = _shifts(template, template.skin.vertices, photos, points, options)
    if len(shifts) < 2:
        alone = dict.fromkeys(shifts, "there is no other photograph that it could be compared with")
        return JudgedPhotos({}, unjudged | alone)
    nats = people.apart([*shifts.values()])
    return JudgedPhotos(dict(zip(shifts, nats, strict=True)), unjudged)


def find_other_person(
    name: str, nats: float, known: str, options: PersonOptions = PERSON_OPTIONS
) -> Iterator[Finding]:
    """Yield the warning ``photo.other_person`` about a photograph by the nats found of it.

    ``known`` is who is meant, in words.
    """
    if nats > options.warn_nats:
        message = (
            f"{name}: by its landmarks this is likelier somebody else than {known} "
            f"(by {nats:.1f} nats, told from {options.warn_nats:g} on)"
        )
        yield make_warning("photo.other_person", message, {"file": name, "nats": round(nats, 2)})


def _shifts(
    template: Template,
    neutral: Floats,
    photos: Mapping[str, Photo],
    points: SkinPoints,
    options: PersonOptions,
) -> tuple[dict[str, Floats], dict[str, str]]:
    """Return b (n,) of the photographs that show enough, and what is wrong with others."""
    found = {}
    unjudged = {}
    shapes = PersonShapes.of(template)
    skin = template.skin.with_vertices(neutral)
    for name, photo in photos.items():
        if photo.eyes_px is None:
            unjudged[name] = "the outer corners of the eyes are not marked"
            continue
        if photo.eyes_px < options.eyes_px:
            unjudged[name] = (
                f"the outer corners of the eyes are less than {options.eyes_px:g} px apart"
            )
            continue
        try:
            shift = person_shift(shapes, skin, photo, points, options)
        except InputError:  # which the fit tells
            unjudged[name] = "its landmarks place no camera"
            continue
        if shift is None:
            unjudged[name] = f"fewer than {options.least_points} of the detector's points are seen"
        else:
            found[name] = shift.b
    return found, unjudged


def person_shift(
    shapes: PersonShapes,
    skin: Surface,
    photo: Photo,
    points: SkinPoints,
    options: PersonOptions = PERSON_OPTIONS,
) -> PersonShift | None:
    """Return what identity shapes would change of a face's ``skin``; None for too few points.

    Raises :class:`InputError` as :func:`~solver.photo.identity.see_person`.
    """
    marks = points.detected()
    if len(photo.landmarks.keys() & set(marks.names)) < options.least_points:
        return None
    seen = see_person(shapes, skin, photo, marks, options.views)
    term = seen.view.terms[0]
    found = term.linearise(seen.skin, seen.camera)
    if len(found.residual) < 2 * options.least_points:
        return None
    root = np.sqrt(options.views.fit.loss.weights(found.residual))
    by_weights = found.by_skin @ seen.expressions
    at_rest = root * (found.residual - by_weights @ seen.weights)
    by_person = root[:, None] * (found.by_skin @ shapes.identity)
    spread = np.repeat([options.turn, options.shift_mm, options.focal], [3, 3, 1])
    free = found.by_camera[:, : len(spread) if seen.view.focal else POSE_FREEDOM]
    others = root[:, None] * np.hstack(
        [options.expression * by_weights, free * spread[: free.shape[1]]]
    )
    # what expressions and camera explain is taken out
    inner = np.eye(others.shape[1]) + others.T @ others
    left = np.column_stack([at_rest, by_person])
    left = left - others @ np.linalg.solve(inner, others.T @ left)
    information = by_person.T @ left[:, 1:]
    b = -np.linalg.solve(shapes.prior + information, by_person.T @ left[:, 0])
    return PersonShift(b, information)
