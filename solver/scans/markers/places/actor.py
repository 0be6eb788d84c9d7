"""Carry another actor's motion to a person, by a smooth warp between both faces at rest.

    c_k = place_k + J_k (y_k - n_k),    J_k = grad W(S n_k) s R

y is a marker in the actor's head frame, n where it is at rest, and place where it is bound on the
person. S = (s, R, t) is the similarity of n to the places; the warp W takes up what S misses, as
lips and brows of two people differ by more than a size. It is the biharmonic spline (see
:mod:`solver.anatomy.warp`) without an affine part, which few markers on a face do not determine.
What rides on bone is carried by S alone.

The head's motion is what all frames of the take give (``signal/motion.py``): few takes have markers
of the head. It is put back afterwards, in the person's size, so that the fit finds the head as in
any take. Errors of the motion are thus taken off and put back alike, and only the part of J that is
no similarity turns them into a motion of the face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import RBFInterpolator

from solver.errors import Finding, InputError, make_warning, quote_names
from solver.scans.markers.places.bind import onto_places, places_of, rest_places
from solver.scans.markers.places.locate import FLIP, fit_most
from solver.scans.markers.places.marker_set import BONY, MarkerSet
from solver.scans.markers.readers.names import read_names
from solver.scans.markers.readers.take import Take
from solver.scans.markers.signal.faults import Faults, find_faults
from solver.scans.markers.signal.motion import (
    Mask,
    Motion,
    median_of_seen,
    refuse_flat,
    rms_of_seen,
)
from solver.scans.markers.signal.rest import compare_rests, likely_rests, rivals
from solver.similarity import IDENTITY, Similarity
from solver.surface import Floats, Surface


@dataclass(frozen=True)
class ActorOptions:
    """The warp between two faces at rest, and what is no face; lengths in mm."""

    least: int = 6  # markers of the skin that make a warp
    smoothing: float = 20.0  # of it: markers are not on the very same places of two faces
    reach: float = 5.0  # to both sides, of its derivative's differences: it has edges at markers
    sizes: tuple[float, float] = (0.6, 1.65)  # of the person by the actor
    misfit: float = 12.0  # of most markers, by a similarity
    mirrored: float = 0.6  # of the misfit: the other way round it fits that much better
    stretches: tuple[float, float] = (0.5, 2.0)  # of the warp; beyond them the similarity carries
    extreme: float = 0.3  # of the skin's markers beyond them: it is no such face
    far: float = 60.0  # from its place no marker goes, with the mouth wide open either ...
    seldom: float = 0.02  # ... but thrown off, in so much of its time


ACTOR = ActorOptions()


@dataclass(frozen=True)
class ActorWarp:
    """The way of k markers from an actor's head frame to the person's frame."""

    rest: Floats  # (k, 3) of the actor, NaN for a marker that is never seen
    places: Floats  # (k, 3) on the person
    similarity: Similarity  # of rest to places; it mirrors if the take's axes are left-handed
    jacobians: Floats  # (k, 3, 3) of what is carried, by the actor's points
    stretches: Floats  # (k, 2) least and greatest of the warp, after the similarity
    extreme: Mask  # (k,) the similarity alone carries it
    missed: Floats  # (k,) by the similarity, mm; NaN for what rides on bone
    left: Floats  # (k,) by the warp

    def __call__(self, points: Floats, marker: int) -> Floats:
        """Return points (n, 3) carried as the marker's."""
        moved = (points - self.rest[marker]) @ self.jacobians[marker].T
        return np.asarray(self.places[marker] + moved)


@dataclass(frozen=True)
class CarriedTake:
    """A take as if the person had played it, in the model's axes."""

    take: Take
    markers: MarkerSet  # as read there
    report: dict[str, Any]  # what was carried, as JSON values
    notices: tuple[Finding, ...]  # what was not


def carry(
    take: Take,
    markers: MarkerSet,
    skin: Surface,
    rate: float,
    neutral: tuple[int, int] | None = None,
    options: ActorOptions = ACTOR,
) -> CarriedTake:
    """Carry a take of another person, at rest in the ``neutral`` rows, to the places of a set.

    All of its labels are seen in some frame.
    Without these rows the likeliest rest is taken (``signal/rest.py``). Raises :class:`InputError`:
    ``markers.few``, ``markers.flat``, ``markers.mirrored``, or ``markers.other_person`` where the
    markers at rest do not lie like these places, in any size.
    """
    used = {each.label: each for each in markers.used}
    take = take.pick([number for number, label in enumerate(take.labels) if label in used])
    on_bone = np.array([used[label].part in BONY for label in take.labels], bool)
    scale = markers.session.scale
    if np.sum(~on_bone) < options.least:
        raise _few_error(take.file, int(np.sum(~on_bone)))
    faults = find_faults(scale * take.positions, rate)
    motion = faults.motion
    rows, unclear = (neutral, []) if neutral else _find_rest(take, faults, rate)
    rest = _at_rest(motion, rows)
    goal = places_of(take.labels, markers, rest_places(markers, skin))
    warp = fit_warp(take.file, rest, goal, on_bone, markers.session.rotation, options)
    turns, shifts = _head_motions(motion, warp.similarity, sum(rows) // 2)
    places = _carry_labels(faults, warp)

    def put_back(points: Floats) -> Floats:
        return np.asarray(np.einsum("fij,fkj->fki", turns, points) + shifts[:, None])

    carried = replace(
        take,
        positions=put_back(places),
        unlabelled=put_back(_carry_free(scale * take.unlabelled, motion, warp)),
        sigma=None if take.sigma is None else _carry_sigma(scale * take.sigma, motion, warp, turns),
    )
    far = np.linalg.norm(places - goal, axis=2) > options.far
    often = far.sum(axis=0) > options.seldom * np.isfinite(places[..., 0]).sum(axis=0)
    report = _report(take.labels, warp, often)
    report["neutral"] = [take.numbers[row] for row in rows]
    read = replace(markers, session=IDENTITY)
    notices = (*unclear, *_notices(take.labels, warp, often))
    return CarriedTake(carried, read, report, notices)


def off_places(
    take: Take, markers: MarkerSet, motion: Motion, skin: Surface, rows: tuple[int, int]
) -> float:
    """Return how far a take's markers at rest are off a set's places, mm rms; 0 for too few."""
    rest = _at_rest(motion, rows) @ markers.session.rotation.T
    goal = places_of(take.labels, markers, rest_places(markers, skin))
    to_places = onto_places(rest, goal, ACTOR.least)
    if to_places is None:
        return 0.0
    return rms_of_seen(np.linalg.norm(to_places(rest) - goal, axis=1))


def _find_rest(take: Take, faults: Faults, rate: float) -> tuple[tuple[int, int], list[Finding]]:
    """Return the rows of the likeliest rest, and a notice if another pose may be rest as well."""
    rests = likely_rests(faults, read_names(take.labels), rate)
    others = rivals(rests[0], rests)
    if not others:
        return rests[0].rows, []
    compared = compare_rests(rests[0], others[0], take.labels, take.numbers)
    message = compared.pop("message")
    return rests[0].rows, [make_warning("markers.unclear_rest", message, compared)]


def _at_rest(motion: Motion, rows: tuple[int, int]) -> Floats:
    """Return markers (k, 3) at rest in the head's frame; hidden ones follow from the others."""
    span = slice(rows[0], rows[1] + 1)
    rest = median_of_seen(motion.places[span])
    expected = median_of_seen(motion.expected[span])
    return np.where(np.isfinite(rest), rest, expected)


def fit_warp(
    file: str,
    rest: Floats,
    goal: Floats,
    on_bone: Mask,
    turn: Floats,
    options: ActorOptions = ACTOR,
) -> ActorWarp:
    """Return the way of markers at ``rest`` (k, 3) to places ``goal`` (k, 3) on the person.

    ``turn`` (3, 3) takes the actor's axes to the person's, and mirrors if they are left-handed.
    Raises :class:`InputError` as :func:`carry` does.
    """
    known = np.isfinite(rest[:, 0]) & np.isfinite(goal[:, 0]) & ~on_bone
    if known.sum() < options.least:
        raise _few_error(file, int(known.sum()))
    refuse_flat(file, rest[known])
    turned = rest @ turn.T
    similar, misfit = fit_most(turned[known], goal[known])
    _check_similar(file, similar, misfit, fit_most(turned[known] @ FLIP, goal[known])[1])
    placed = similar(turned)
    further = RBFInterpolator(
        placed[known],
        goal[known] - placed[known],
        kernel="linear",
        degree=0,
        smoothing=options.smoothing,
    )
    gradients = np.tile(np.eye(3), (len(rest), 1, 1))
    for axis, step in enumerate(options.reach * np.eye(3)):
        change = further(placed[known] + step) - further(placed[known] - step)
        gradients[known, :, axis] += change / (2 * options.reach)
    stretches = np.asarray(np.linalg.svd(gradients, compute_uv=False)[:, [2, 0]], np.float64)
    extreme = (stretches[:, 0] < options.stretches[0]) | (stretches[:, 1] > options.stretches[1])
    extreme |= np.linalg.det(gradients) <= 0.0
    if extreme.sum() > options.extreme * known.sum():
        raise _unlike_error(file, similar.scale, misfit)
    gradients[extreme] = np.eye(3)
    off = np.where(known[:, None], goal - placed, np.nan)
    left = np.full(len(rest), np.nan)
    left[known] = np.linalg.norm(off[known] - further(placed[known]), axis=1)
    whole = Similarity(similar.scale, similar.rotation @ turn, similar.shift)
    jacobians = whole.scale * gradients @ whole.rotation
    missed = np.linalg.norm(off, axis=1)
    return ActorWarp(rest, goal, whole, jacobians, stretches, extreme, missed, left)


def _check_similar(file: str, similar: Similarity, misfit: float, flipped: float) -> None:
    """Refuse markers that lie like the places only if mirrored, or not at all."""
    if flipped < ACTOR.mirrored * misfit:
        message = (
            f"{file} is mirrored: its axes are not of the marker set's handedness, or its labels "
            "of left and right are exchanged"
        )
        raise InputError("markers.mirrored", message, file=file)
    low, high = ACTOR.sizes
    if misfit > ACTOR.misfit or not low <= similar.scale <= high:
        raise _unlike_error(file, similar.scale, misfit)


def _few_error(file: str, found: int) -> InputError:
    message = (
        f"{file} has {found} markers of the set on the skin while the face is at rest: to carry "
        f"an actor's motion {ACTOR.least} are needed"
    )
    return InputError("markers.few", message, file=file, found=found, expected=ACTOR.least)


def _unlike_error(file: str, scale: float, misfit: float) -> InputError:
    message = (
        f"the markers of {file} at rest do not lie like the marker set's places on any person: "
        f"most are {misfit:.0f} mm off, at {scale:.3g} times their size"
    )
    figures = {"found": round(misfit, 1), "expected": ACTOR.misfit, "scale": round(scale, 3)}
    return InputError("markers.other_person", message, file=file, **figures)


def _head_motions(motion: Motion, similar: Similarity, row: int) -> tuple[Floats, Floats]:
    """Return the head's motions since ``row`` in the person's frame: (f, 3, 3) and (f, 3)."""
    back = np.einsum("ij,fkj->fik", motion.rotations[row], motion.rotations)
    moved = motion.shifts[row] - np.einsum("fij,fj->fi", back, motion.shifts)
    turns = np.einsum("ij,fjk,lk->fil", similar.rotation, back, similar.rotation)
    return turns, similar(moved) - turns @ similar.shift


def _carry_labels(faults: Faults, warp: ActorWarp) -> Floats:
    """Return the markers (f, k, 3) on a person whose head is still; what is not measured is NaN.

    Where a label has another's point, that is carried as the other's: so the fit can give it back.
    """
    seen = np.where(faults.unmeasured[..., None], np.nan, faults.motion.places)
    carried = np.stack([warp(seen[:, marker], marker) for marker in range(seen.shape[1])], axis=1)
    for span in faults.of("swapped", "relabelled"):
        if span.other is not None:
            rows = slice(span.first, span.last + 1)
            carried[rows, span.marker] = warp(seen[rows, span.marker], span.other)
    return carried


def _carry_free(points: Floats, motion: Motion, warp: ActorWarp) -> Floats:
    """Return points (f, u, 3) without a label on a still head, each as the nearest marker's."""
    seen = np.einsum("fij,fuj->fui", motion.rotations, points) + motion.shifts[:, None]
    carried = np.full(seen.shape, np.nan)
    expected = np.where(np.isfinite(warp.rest), motion.expected, np.inf)
    for track in range(seen.shape[1]):
        rows = np.flatnonzero(np.isfinite(seen[:, track, 0]))
        away = np.linalg.norm(expected[rows] - seen[rows, track, None], axis=2)
        nearest = away.argmin(axis=1)
        for marker in np.unique(nearest).tolist():
            own = rows[nearest == marker]
            carried[own, track] = warp(seen[own, track], marker)
    return carried


def _carry_sigma(sigma: Floats, motion: Motion, warp: ActorWarp, turns: Floats) -> Floats:
    """Return the standard deviations (f, k, 3) of what is carried."""
    carried = np.empty_like(sigma)
    for marker, jacobian in enumerate(warp.jacobians):
        whole = turns @ jacobian @ motion.rotations
        carried[:, marker] = np.sqrt(np.einsum("fij,fj->fi", whole**2, sigma[:, marker] ** 2))
    return carried


def _report(labels: Sequence[str], warp: ActorWarp, often: Mask) -> dict[str, Any]:
    """Return what was carried, as JSON values; null for what rides on bone."""
    rows = {}
    for number, label in enumerate(labels):
        known = np.isfinite(warp.left[number])
        rows[label] = {
            "missed_mm": round(float(warp.missed[number]), 2) if known else None,
            "left_mm": round(float(warp.left[number]), 2) if known else None,
            "stretch": warp.stretches[number].round(3).tolist() if known else None,
            "by_similarity": bool(warp.extreme[number] or not known),
            "off_face": bool(often[number]),
        }
    return {
        "scale": round(warp.similarity.scale, 4),
        "missed_mm": round(rms_of_seen(warp.missed), 2),
        "left_mm": round(rms_of_seen(warp.left), 2),
        "markers": rows,
    }


def _notices(labels: Sequence[str], warp: ActorWarp, often: Mask) -> tuple[Finding, ...]:
    """Return which markers the warp does not carry, and which left the face."""
    found = []
    if warp.extreme.any():
        names = quote_names([labels[each] for each in np.flatnonzero(warp.extreme).tolist()])
        message = f"carried by size alone, the faces differ too much about them: {', '.join(names)}"
        found.append(make_warning("markers.carried", message, {"labels": names}))
    if often.any():
        names = quote_names([labels[each] for each in np.flatnonzero(often).tolist()])
        message = f"carried more than {ACTOR.far:g} mm off their places: {', '.join(names)}"
        found.append(make_warning("markers.off_face", message, {"labels": names}))
    return tuple(found)
