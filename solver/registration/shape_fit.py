"""The template's own shapes fitted to a scan: who it is, or which expression.

    min over c, motion of  sum_i w_i (n_i . (x_i(c) - q_i))^2 / s^2  +  c . P c

P is the prior: for a person |c|^2 and lips that stay closed, for an expression a little |c|^2 with
0 <= c <= 1.2.

Closest points q_i are found anew in every round and outliers lose their weight (the shape model's
prior follows Blanz & Vetter 1999; the alternation is that of iterated closest points).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from solver.anatomy.template import ShapeBasis, Template
from solver.registration.scan_surface import Samples, ScanSurface
from solver.registration.topology import Topology
from solver.similarity import Similarity, small_motion
from solver.surface import Floats, Ints, Surface, vertex_areas, vertex_normals

# Pairs of model points and scan points, with the weight each pair deserves.


# Normals further apart than 60 degrees are not of the same place.
MIN_COSINE = 0.5


@dataclass(frozen=True)
class Pairs:
    """Scan points for the model's points, in the template's frame.

    ``points`` and ``normals`` (n, 3) of the scan; ``offset`` (n,) how far the scan lies along its
    normal, in mm; ``weights`` (n,) in [0, 1], zero where there is nothing to follow.
    """

    points: Floats
    normals: Floats
    offset: Floats
    weights: Floats


@dataclass(frozen=True)
class Pins:
    """Landmarks: ``points`` (k, 3) of the scan and the ``vertices`` (k,) they mark."""

    points: Floats
    vertices: Ints


def pair(
    scan: ScanSurface,
    motion: Similarity,
    points: Floats,
    normals: Floats,
    reach: float,
    *,
    alike: bool = False,
) -> Pairs:
    """Return the closest points of a moved scan to model ``points`` (n, 3).

    ``reach`` (mm) is the distance at which a pair's weight is a quarter (Geman & McClure 1987) and
    a third of the one at which it is none; neither edges of the scan nor surfaces that face
    elsewhere count. With ``alike``, points that face the same way come before closer ones.
    """
    back = motion.inverse()
    found = scan.alike(back(points), back.turn(normals)) if alike else scan.closest(back(points))
    targets, directions = motion(found.points), motion.turn(found.normals)
    distance = found.distance * motion.scale
    cosine = np.einsum("nd,nd->n", normals, directions)
    weights = 1 / (1 + (distance / reach) ** 2) ** 2
    weights *= np.clip((cosine - MIN_COSINE) / (0.9 - MIN_COSINE), 0.0, 1.0)
    weights[found.at_edge | (distance > 3 * reach)] = 0.0
    offset = np.einsum("nd,nd->n", targets - points, directions)
    return Pairs(targets, directions, offset, weights)


def add_pins(pairs: Pairs, points: Floats, targets: Floats, weight: float) -> Pairs:
    """Add landmarks: model ``points`` (k, 3) held at ``targets`` (k, 3) along all three axes."""
    axes = np.tile(np.eye(3), (len(points), 1))
    places, goals = np.repeat(points, 3, axis=0), np.repeat(targets, 3, axis=0)
    return Pairs(
        np.concatenate([pairs.points, goals]),
        np.concatenate([pairs.normals, axes]),
        np.concatenate([pairs.offset, np.einsum("nd,nd->n", goals - places, axes)]),
        np.concatenate([pairs.weights, np.full(len(axes), weight)]),
    )


def motion_columns(pairs: Pairs, *, sizes: bool) -> Floats:
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
    strongest: float = 1.2  # weight of an expression
    expression_prior: float = 0.5  # on the squares of their weights
    closed_mm: float = 0.15  # standard deviation of the gap between closed lips


FIT = ShapeFitOptions()


@dataclass(frozen=True)
class Shapes:
    """Displacements (k, n, 3) in mm from ``start`` (n, 3), and the ``prior`` (k, k) on weights.

    With ``bounded`` all weights lie in [0, 1.2].
    """

    start: Floats
    displacements: NDArray[np.floating]
    prior: Floats
    bounded: bool

    def at(self, weights: Floats) -> Floats:
        """Return the vertices (n, 3) with these weights (k,)."""
        return np.asarray(self.start + np.tensordot(weights, self.displacements, 1))


def persons(topology: Topology, basis: ShapeBasis, options: ShapeFitOptions = FIT) -> Shapes:
    """Return the identities of a template: independent, of unit variance, the lips closed."""
    one, other = topology.touching.T
    gaps = (basis.identity[:, one] - basis.identity[:, other]).reshape(len(basis.identity), -1)
    prior = np.eye(len(gaps)) + options.independent / options.closed_mm**2 * (gaps @ gaps.T)
    return Shapes(topology.template.skin.vertices, basis.identity, np.asarray(prior), bounded=False)


def expressions(neutral: Floats, basis: ShapeBasis, options: ShapeFitOptions = FIT) -> Shapes:
    """Return the expressions of a person with this ``neutral`` (n, 3)."""
    prior = options.expression_prior * np.eye(len(basis.expressions))
    return Shapes(neutral, basis.expressions, prior, bounded=True)


@dataclass(frozen=True)
class ShapeFit:
    """The weights (k,), the fitted ``vertices`` (n, 3), and the scan's motion onto them."""

    weights: Floats
    vertices: Floats
    motion: Similarity


def fit_shapes(
    scan: ScanSurface,
    motion: Similarity,
    shapes: Shapes,
    topology: Topology,
    pins: Pins | None = None,
    options: ShapeFitOptions = FIT,
    *,
    sizes: bool,
) -> ShapeFit:
    """Fit weights and motion together; with ``sizes`` the scan's size may change.

    ``pins`` guide the rounds in which the scan's points are still far.
    """
    outer, faces = topology.outer, topology.template.skin.faces
    count = len(shapes.prior)
    weights = np.zeros(count)
    for reach in options.reaches_mm:
        model = shapes.at(weights)
        normals = vertex_normals(Surface(model, faces))[outer]
        pairs = pair(scan, motion, model[outer], normals, reach)
        trust = pairs.weights * options.independent / (options.noise * reach) ** 2
        pairs, rows = replace(pairs, weights=trust), outer
        if pins is not None and reach >= options.pinned_reach_mm:
            places, goals = model[pins.vertices], motion(pins.points)
            pairs = add_pins(pairs, places, goals, 1 / options.pin_mm**2)
            rows = np.concatenate([outer, np.repeat(pins.vertices, 3)])
        basis = np.einsum("knd,nd->nk", shapes.displacements[:, rows], pairs.normals)
        # offset = n . (q - x): the model moves by its weights, the scan by its motion
        columns = np.hstack([-basis, motion_columns(pairs, sizes=sizes)])
        weighted = columns * pairs.weights[:, None]
        normal = weighted.T @ columns
        right = -weighted.T @ (pairs.offset + basis @ weights)
        normal[:count, :count] += shapes.prior
        normal[np.diag_indices_from(normal)] += 1e-9
        solution = _solve(normal, right, count if shapes.bounded else 0, options.strongest)
        weights, step = solution[:count], solution[count:]
        motion = motion.then(small_motion(step[:6], float(step[6]) if sizes else 0.0))
    return ShapeFit(weights, shapes.at(weights), motion)


def _solve(normal: Floats, right: Floats, bounded: int, strongest: float) -> Floats:
    """Minimise x N x / 2 - r x, the first ``bounded`` unknowns within [0, ``strongest``]."""
    if not bounded:
        return np.asarray(np.linalg.solve(normal, right))
    root = np.linalg.cholesky(normal)
    lower, upper = np.full(len(right), -np.inf), np.full(len(right), np.inf)
    lower[:bounded], upper[:bounded] = 0.0, strongest
    return np.asarray(lsq_linear(root.T, np.linalg.solve(root, right), (lower, upper)).x)


# Rigid motion, and uniform scale where asked for, of a scan onto a model of fixed shape.


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

    Parameters
    ----------
    points, normals
        (n, 3) of the model, in mm.
    trust
        (n,) weights of the model's points, all 1 by default.
    sizes
        Whether the scan's size may change.
    """
    for reach in RIGID_REACHES_MM:
        pairs = pair(scan, motion, points, normals, reach)
        weights = pairs.weights if trust is None else pairs.weights * trust
        columns = motion_columns(pairs, sizes=sizes)
        weighted = columns * weights[:, None]
        normal = weighted.T @ columns
        normal[np.diag_indices_from(normal)] += 1e-9 * np.trace(normal) + 1e-12
        step = np.asarray(np.linalg.solve(normal, -weighted.T @ pairs.offset), np.float64)
        motion = motion.then(small_motion(step[:6], float(step[6]) if sizes else 0.0))
    return motion


# A template's shapes fitted roughly to a scan: who it is like, and with which expression.
#
#     min over c, similarity of  sum_i w_i (n_i . (x_i(c) - q_i))^2 / s^2  +  |c / sigma|^2
#
# with closest points q_i of the scan. A quick look, not a registration: a few thousand points, no
# free form. Persons and expressions are fitted together, as nothing is known of the scan.


@dataclass(frozen=True)
class LikenessOptions:
    """Numbers of a rough fit of persons and expressions together."""

    reaches_mm: tuple[float, ...] = (10.0, 8.0, 6.0, 5.0, *(4.0,) * 5, *(3.0,) * 5)
    noise: float = 0.25  # standard deviation of the distances, by the reach
    independent: float = 0.05  # part of the distances that counts: neighbouring ones go together
    identities: int = 30  # shapes of persons that it uses
    expression_sd: float = 0.35  # standard deviation of an expression's weight
    strongest: float = 1.2  # weight of an expression
    facing: float = 0.6  # least cosine of the normals, of either sign


LIKENESS = LikenessOptions()
IGNORED = ("eyeLook", "Pupil", "tongue")  # expressions that no scan shows


@dataclass(frozen=True)
class Likeness:
    """The fitted template: its whole ``skin`` (n, 3) in mm in its own frame, the scan's motion."""

    skin: Floats
    motion: Similarity


def fit_likeness(
    scan: Samples,
    pose: Similarity,
    template: Template,
    face: Surface,
    options: LikenessOptions = LIKENESS,
) -> Likeness:
    """Fit the template's shapes to a scan from a good ``pose``.

    ``face`` is the part of the skin that is fitted, in the template's numbers. A template without
    shapes is returned as it is, in that pose.
    """
    skin, shapes = template.skin.vertices, template.shapes
    if shapes is None:
        return Likeness(skin, pose)
    numbers, faces = np.unique(face.faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int64)
    chosen = [
        number
        for number, name in enumerate(shapes.expression_names)
        if not name.startswith(IGNORED)
    ]
    basis = np.concatenate([shapes.identity[: options.identities], shapes.expressions[chosen]])
    people = min(options.identities, len(shapes.identity))
    precision = np.full(len(basis), options.expression_sd**-2)
    precision[:people] = 1.0
    weights, found = _fit(
        scan, pose, skin[numbers], faces, basis[:, numbers], precision, people, options
    )
    return Likeness(skin + np.tensordot(weights, basis, 1), found)


def _fit(
    scan: Samples,
    pose: Similarity,
    rest: Floats,
    faces: Ints,
    basis: NDArray[np.float32],
    precision: Floats,
    people: int,
    options: LikenessOptions,
) -> tuple[Floats, Similarity]:
    """Return the weights (k,) of ``basis`` (k, n, 3) and the pose, fitted together.

    The weights behind the first ``people`` are expressions, kept within [0, ``strongest``].
    """
    count = len(basis)
    weights = np.zeros(count)
    tree = KDTree(scan.points)
    area = vertex_areas(rest, faces)
    scale, rotation, translation = pose.scale, pose.rotation, pose.shift
    for reach in options.reaches_mm:
        model = rest + np.tensordot(weights, basis, 1)
        normals = vertex_normals(Surface(model, faces))
        gap, near = tree.query((model - translation) @ rotation / scale)
        matched = scale * scan.points[near] @ rotation.T + translation
        facing = np.abs((scan.normals[near] @ rotation.T * normals).sum(axis=1))
        error = ((matched - model) * normals).sum(axis=1)
        trust = area / area.mean() * np.clip(1 - (gap * scale / reach) ** 2, 0, 1) ** 2
        trust *= (facing > options.facing) * options.independent / (options.noise * reach) ** 2
        centre = matched.mean(axis=0)
        p = matched - centre
        shape_rows = np.einsum("knd,nd->nk", basis, normals)
        motion_rows = [np.cross(p, normals), normals, (p * normals).sum(axis=1)[:, None]]
        rows = np.hstack([shape_rows, *(-part for part in motion_rows)])
        normal = rows.T @ (trust[:, None] * rows) + 1e-9 * np.eye(rows.shape[1])
        normal[range(count), range(count)] += precision
        step = np.linalg.solve(normal, rows.T @ (trust * (error + shape_rows @ weights)))
        weights = step[:count]
        weights[people:] = np.clip(weights[people:], 0.0, options.strongest)
        turn = Rotation.from_rotvec(step[count : count + 3]).as_matrix()
        growth = float(np.clip(1 + step[-1], 0.95, 1.05))
        translation = growth * turn @ (translation - centre) + centre + step[count + 3 : -1]
        rotation, scale = turn @ rotation, growth * scale
    return weights, Similarity(scale, rotation, translation)
