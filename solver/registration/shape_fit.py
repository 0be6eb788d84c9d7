"""The template's own shapes fitted to a scan: who it is, which expression, or both.

    min over c, motion of  sum_i w_i (n_i . (x_i(c) - q_i))^2 / s^2  +  c . P c

P is the prior: for a person |c|^2 and lips that stay closed, for an expression a little |c|^2 with
0 <= c <= 1.2.

Closest points q_i are found anew in every round and outliers lose their weight (the shape model's
prior follows Blanz & Vetter 1999; the alternation is that of iterated closest points).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from solver.anatomy.template import ShapeBasis
from solver.registration.scan_surface import Samples, ScanSurface
from solver.registration.topology import Topology
from solver.similarity import Similarity, robust_weights, small_motion
from solver.surface import Floats, Ints, Surface, vertex_normals

# Cosines of normals: those further apart are not of the same place.
SURFACE_COSINE = 0.5  # of a model and a scan's surface
SAMPLES_COSINE = 0.6  # of a model and a scan's samples
FULL_COSINE = 0.9  # closer ones count in full


@dataclass(frozen=True)
class Correspondences:
    """Closest scan points of the model's points, in the template's frame."""

    points: Floats  # (n, 3) of the scan
    normals: Floats  # (n, 3)
    offset: Floats  # (n,) mm that the scan lies along its normal
    weights: Floats  # (n,) in [0, 1], zero where there is nothing to follow


# Takes the scan's motion, the model's points and normals (n, 3), and the reach in mm.
Match = Callable[[Similarity, Floats, Floats, float], Correspondences]


@dataclass(frozen=True)
class Pins:
    """Landmarks: ``points`` (k, 3) of the scan and the ``vertices`` (k,) they mark."""

    points: Floats
    vertices: Ints


def find_correspondences(
    scan: ScanSurface,
    motion: Similarity,
    points: Floats,
    normals: Floats,
    reach: float,
    *,
    compatible: bool = False,
) -> Correspondences:
    """Return the closest points of a moved scan to model ``points`` (n, 3).

    ``reach`` (mm) is the distance at which a pair's weight is a quarter (Geman & McClure 1987) and
    a third of the one at which it is none; neither edges of the scan nor surfaces that face
    elsewhere count. With ``compatible``, points that face the same way come before closer ones.
    """
    back = motion.inverse()
    if compatible:
        found = scan.closest_compatible(back(points), back.turn(normals))
    else:
        found = scan.closest(back(points))
    targets = motion(found.points)
    directions = motion.turn(found.normals)
    distance = found.distance * motion.scale
    cosine = np.einsum("nd,nd->n", normals, directions)
    weights = robust_weights((distance / reach) ** 2)
    weights *= facing_weights(cosine, SURFACE_COSINE)
    weights[found.at_edge | (distance > 3 * reach)] = 0.0
    offset = np.einsum("nd,nd->n", targets - points, directions)
    return Correspondences(targets, directions, offset, weights)


def facing_weights(cosine: Floats, least: float) -> Floats:
    """Return weights that rise from none at the ``least`` cosine of two normals to 1."""
    return np.clip((cosine - least) / (FULL_COSINE - least), 0.0, 1.0)


def match_samples(scan: Samples, area: Floats) -> Match:
    """Return what pairs model points with the closest of a scan's samples, whatever their winding.

    Pairs lie along the model's normals; a model point weighs as much as its ``area`` (n,), and
    less with the distance, down to none at the reach (Tukey's biweight).
    """

    def match(motion: Similarity, points: Floats, normals: Floats, reach: float) -> Correspondences:
        gap, near = scan.tree.query(motion.inverse()(points))
        targets = motion(scan.points[near])
        facing = np.abs(np.einsum("nd,nd->n", motion.turn(scan.normals[near]), normals))
        weights = area / area.mean() * np.clip(1 - (gap * motion.scale / reach) ** 2, 0, 1) ** 2
        weights *= facing > SAMPLES_COSINE
        return Correspondences(
            targets, normals, np.einsum("nd,nd->n", targets - points, normals), weights
        )

    return match


def add_pins(
    pairs: Correspondences, points: Floats, targets: Floats, weight: float
) -> Correspondences:
    """Add landmarks: model ``points`` (k, 3) held at ``targets`` (k, 3) along all three axes."""
    axes = np.tile(np.eye(3), (len(points), 1))
    goals = np.repeat(targets, 3, axis=0)
    offset = (targets - points).ravel()
    return Correspondences(
        np.concatenate([pairs.points, goals]),
        np.concatenate([pairs.normals, axes]),
        np.concatenate([pairs.offset, offset]),
        np.concatenate([pairs.weights, np.full(len(axes), weight)]),
    )


def motion_columns(pairs: Correspondences, *, sizes: bool) -> Floats:
    """Return the change (n, 6 or 7) of ``offset`` by the scan's rotation, shift and growth."""
    columns = [np.cross(pairs.points, pairs.normals), pairs.normals]
    if sizes:
        columns.append(np.einsum("nd,nd->n", pairs.points, pairs.normals)[:, None])
    return np.hstack(columns)


@dataclass(frozen=True)
class ShapeFitOptions:
    """Numbers of a fit of shapes to a scan."""

    # how far points pair, mm, round by round
    reaches_mm: tuple[float, ...] = (
        *(12.0, 12.0, 10.0, 10.0, 8.0, 8.0, 6.0, 6.0),
        *(4.0,) * 6,
        *(3.0,) * 8,
        *(2.0,) * 6,
    )
    noise: float = 0.2  # standard deviation of the offsets, by the reach
    independent: float = 0.02  # part of the offsets that counts: neighbouring ones go together
    pinned_reach_mm: float = 6.0  # landmarks count while the reach is at least this ...
    pin_mm: float = 3.0  # ... with this standard deviation
    growth: float = 0.05  # of the scan in one round at most
    identities: int | None = None  # that are used, None for all
    strongest: float = 1.2  # weight of an expression
    expression_prior: float = 0.5  # on the squares of their weights
    closed_mm: float = 0.15  # standard deviation of the gap between closed lips


FIT = ShapeFitOptions()
# A quick look, not a registration: nothing is known of the scan, so all shapes are fitted together.
LIKENESS = ShapeFitOptions(
    reaches_mm=(10.0, 8.0, 6.0, 5.0, *(4.0,) * 5, *(3.0,) * 5),
    noise=0.25,
    independent=0.05,
    identities=30,
    expression_prior=0.35**-2,
)
IGNORED = ("eyeLook", "Pupil", "tongue")  # expressions that no scan shows
# those that a scan of a face at rest may show, by the side of the eye
LIDS = {"left": "eyeBlinkLeft", "right": "eyeBlinkRight"}


@dataclass(frozen=True)
class ShapeModel:
    """Linear shape model of a skin with ``faces`` (f, 3)."""

    start: Floats  # (n, 3) of the skin
    displacements: NDArray[np.floating]  # (k, n, 3) in mm
    prior: Floats  # (k, k) on weights
    bounded: NDArray[np.bool_]  # (k,) weights from 0 to ShapeFitOptions.strongest
    faces: Ints
    used: Ints  # (m,) vertices that are fitted

    def at(self, weights: Floats) -> Floats:
        """Return the vertices (n, 3) with these weights (k,)."""
        return np.asarray(self.start + np.tensordot(weights, self.displacements, 1))


def identity_model(topology: Topology, basis: ShapeBasis) -> ShapeModel:
    """Return the identities of a template: independent, of unit variance, the lips closed."""
    skin, (one, other) = topology.template.skin, topology.touching.T
    count = len(basis.identity)
    gaps = (basis.identity[:, one] - basis.identity[:, other]).reshape(count, -1)
    prior = np.eye(count) + FIT.independent / FIT.closed_mm**2 * (gaps @ gaps.T)
    free = np.zeros(count, bool)
    return ShapeModel(skin.vertices, basis.identity, prior, free, skin.faces, topology.outer)


def lid_shapes(basis: ShapeBasis | None) -> dict[str, NDArray[np.floating]]:
    """Return the displacements (n, 3) of the template's shut lids by their side, if it has them."""
    known = () if basis is None else basis.expression_names
    sides = {side: known.index(name) for side, name in LIDS.items() if name in known}
    return {} if basis is None else {k: basis.expressions[each] for k, each in sides.items()}


def neutral_model(topology: Topology, basis: ShapeBasis) -> ShapeModel:
    """Return the identities of a template, and after them the lids that a scan may have shut."""
    people = identity_model(topology, basis)
    lids = [*lid_shapes(basis).values()]
    prior = scipy.linalg.block_diag(people.prior, FIT.expression_prior * np.eye(len(lids)))
    displacements = np.concatenate([people.displacements, *(lid[None] for lid in lids)])
    bounded = np.arange(len(displacements)) >= len(people.displacements)
    return replace(people, displacements=displacements, prior=prior, bounded=bounded)


def expression_model(neutral: Floats, topology: Topology, basis: ShapeBasis) -> ShapeModel:
    """Return the expressions of a person with this ``neutral`` (n, 3)."""
    count = len(basis.expressions)
    faces = topology.template.skin.faces
    prior = FIT.expression_prior * np.eye(count)
    bounded = np.ones(count, bool)
    return ShapeModel(neutral, basis.expressions, prior, bounded, faces, topology.outer)


def full_model(skin: Floats, face: Surface, basis: ShapeBasis) -> ShapeModel:
    """Return identities and expressions of a template's ``skin`` (n, 3) together.

    ``face`` is the part of it that is fitted, in its numbers.
    """
    names = enumerate(basis.expression_names)
    shown = [number for number, name in names if not name.startswith(IGNORED)]
    people = basis.identity[: LIKENESS.identities]
    bounded = np.arange(len(people) + len(shown)) >= len(people)
    prior = np.diag(np.where(bounded, LIKENESS.expression_prior, 1.0))
    both = np.concatenate([people, basis.expressions[shown]])
    return ShapeModel(skin, both, prior, bounded, face.faces, np.unique(face.faces))


@dataclass(frozen=True)
class TemplateFit:
    """The template fitted to a scan: weights (k,), ``vertices`` (n, 3), and the scan's motion."""

    weights: Floats
    vertices: Floats
    motion: Similarity


def fit_shapes(
    match: Match,
    motion: Similarity,
    shapes: ShapeModel,
    pins: Pins | None = None,
    options: ShapeFitOptions = FIT,
    *,
    sizes: bool,
) -> TemplateFit:
    """Fit weights and motion together; with ``sizes`` the scan's size may change.

    ``match`` finds the scan's points, ``pins`` guide the rounds in which these are still far.
    """
    count = len(shapes.prior)
    weights = np.zeros(count)
    motions = np.full(7 if sizes else 6, np.inf)
    lower = np.concatenate([np.where(shapes.bounded, 0.0, -np.inf), -motions])
    upper = np.concatenate([np.where(shapes.bounded, options.strongest, np.inf), motions])
    for reach in options.reaches_mm:
        model = shapes.at(weights)
        rows = shapes.used
        normals = vertex_normals(Surface(model, shapes.faces))[rows]
        pairs = match(motion, model[rows], normals, reach)
        trust = pairs.weights * options.independent / (options.noise * reach) ** 2
        pairs = replace(pairs, weights=trust)
        if pins is not None and reach >= options.pinned_reach_mm:
            places = model[pins.vertices]
            goals = motion(pins.points)
            pairs = add_pins(pairs, places, goals, 1 / options.pin_mm**2)
            rows = np.concatenate([rows, np.repeat(pins.vertices, 3)])
        basis = np.einsum("knd,nd->nk", shapes.displacements[:, rows], pairs.normals)
        # offset = n . (q - x): the model moves by its weights, the scan by its motion
        columns = np.hstack([-basis, motion_columns(pairs, sizes=sizes)])
        weighted = columns * pairs.weights[:, None]
        normal = weighted.T @ columns
        right = -weighted.T @ (pairs.offset + basis @ weights)
        normal[:count, :count] += shapes.prior
        normal[np.diag_indices_from(normal)] += 1e-9
        root = np.linalg.cholesky(normal)
        solution = lsq_linear(root.T, np.linalg.solve(root, right), (lower, upper)).x
        weights = solution[:count]
        step = solution[count:]
        growth = float(np.clip(step[6], -options.growth, options.growth)) if sizes else 0.0
        motion = motion.then(small_motion(step[:6], growth))
    return TemplateFit(weights, shapes.at(weights), motion)


RIGID_REACHES_MM = (12.0, 10.0, 8.0, 6.0, 5.0, 4.0, 4.0, 3.0, 3.0, 3.0, 3.0, 3.0)  # of the rounds


def align(
    scan: ScanSurface,
    motion: Similarity,
    points: Floats,
    normals: Floats,
    trust: Floats | None = None,
    *,
    sizes: bool,
) -> Similarity:
    """Return ``motion`` improved by robust point-to-plane steps (Chen & Medioni 1992).

    ``points`` and ``normals`` (n, 3) are the model's, in mm, ``trust`` (n,) the weights of its
    points, all 1 by default. With ``sizes`` the scan's size may change.
    """
    for reach in RIGID_REACHES_MM:
        pairs = find_correspondences(scan, motion, points, normals, reach)
        weights = pairs.weights if trust is None else pairs.weights * trust
        columns = motion_columns(pairs, sizes=sizes)
        weighted = columns * weights[:, None]
        normal = weighted.T @ columns
        normal[np.diag_indices_from(normal)] += 1e-9 * np.trace(normal) + 1e-12
        step = np.asarray(np.linalg.solve(normal, -weighted.T @ pairs.offset), np.float64)
        motion = motion.then(small_motion(step[:6], float(step[6]) if sizes else 0.0))
    return motion
