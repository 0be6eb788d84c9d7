"""Changes of a person's anatomy: fat, filler, stiffness, density, paralysis, and moved bones.

Where a change applies may be painted on the skin: a map (V,) has a value between 0 and 1 for every
vertex of the scan topology.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from solver.anatomy.embedding import LooseSkin
from solver.anatomy.tetrahedra import ML, volumes
from solver.edits import Edited
from solver.errors import InputError
from solver.mechanics.flesh import shape_gradients
from solver.mechanics.harmonic import HarmonicExtension, laplacian
from solver.model import SubjectModel, find_muscles, tell_muscles
from solver.surface import (
    Floats,
    Ints,
    Surface,
    adjacency,
    distance_to_path,
    vertex_areas,
    vertex_normals,
)

STEEPEST = 8.0 / (3.0 * np.sqrt(3.0))  # the greatest slope of (1 - t^2)^2


@dataclass(frozen=True)
class Fat:
    """Growth f_i = f_min (1 - s_i0) + f_max s_i0 of F_p = f I, where a map says.

    Muscle grows by ``f_min``, passive flesh by ``f_max``; s_i0 is the passive share of a tet in the
    anatomy. (1.0, 0.8) is slim, (1.0, 1.4) fat, in compartments. A ``painted`` map (V,) draws f
    towards 1, with a ``depth_mm`` also far under the skin (:func:`into_volume`), and so do the
    ends of the model's flesh. Where f > 1 the stiffness is divided by f^``softening``, as it is the
    same tissue in more volume; the exponent is ours.
    """

    f_min: float
    f_max: float
    painted: Floats | None = None
    softening: float = 3.0
    depth_mm: float | None = None

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.fat`` for a growth out of all measure."""
        options = before.options
        low, high = options.fat_growth
        for factor in (self.f_min, self.f_max):
            if not low <= factor <= high:
                reason = f"flesh grows by a factor between {low} and {high}, not {factor}"
                raise InputError("scene.fat", reason, found=factor)
        # not of a fitted S: to a fit, fat that moves with a muscle is as good as muscle
        passive = before.model.weights[:, [0]].toarray()[:, 0]
        whole = self.f_min * (1.0 - passive) + self.f_max * passive
        share = into_volume(before.model, self.painted, options.blur_mm, self.depth_mm)
        share = share * off_the_ends(before.model, options.fade_mm)
        growth = 1.0 + (whole - 1.0) * share
        softer = np.maximum(growth, 1.0) ** -self.softening
        return replace(
            before, growth=before.growth * growth, stiffness_factor=before.stiffness_factor * softer
        )


def off_the_ends(model: SubjectModel, fade_mm: float) -> Floats:
    """Return 0 for tets (n,) where the model ends but the person goes on, 1 from ``fade_mm`` on."""
    ends = np.vstack([model.rest[model.cut], _border(model)])
    if not len(ends):
        return np.ones(len(model.tets))
    return _smooth(cKDTree(ends).query(model.tet_centres)[0] / fade_mm)


def _border(model: SubjectModel) -> Floats:
    """Return the skin's points (k, 3) that follow the flesh beside some that do not.

    They lie on several lines; the points are those of the one around the whole face, not of those
    in mouth, nose and eyes.
    """
    follows = np.zeros(len(model.skin.vertices), dtype=bool)
    follows[model.embedded] = True
    count = follows[model.skin.faces].sum(axis=1)
    mixed = model.skin.faces[(count > 0) & (count < 3)]
    _, part = connected_components(adjacency(mixed, len(follows)), directed=False)
    lines = [model.skin.vertices[(part == number) & follows] for number in np.unique(part[mixed])]
    return max(lines, key=lambda line: float(np.ptp(line, axis=0).max()), default=np.zeros((0, 3)))


@dataclass(frozen=True)
class Filler:
    """Filler of ``ml``, injected along a needle's ``path`` (k, 3), mm in the frame of the rest.

    The flesh grows by f of F_p = f I with f^3 = 1 + alpha exp(-d^2 / (2 radius^2)), d being the
    distance to the path; alpha is such that the flesh, were it free, grew by the given volume.
    """

    path: Floats
    ml: float
    radius_mm: float = 2.5

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.filler`` where there is no room for it."""
        model = before.model
        options = before.options
        if not (self.ml > 0.0 and self.radius_mm > 0.0 and len(self.path)):
            reason = "a filler needs a path, and a volume and a radius above 0"
            raise InputError("scene.filler", reason)
        away = distance_to_path(model.tet_centres, self.path)
        shares = np.exp(-0.5 * (away / self.radius_mm) ** 2)
        room = float((volumes(model.rest, model.tets) * before.growth**3) @ shares)
        near = f"within {self.radius_mm} mm of the path"
        if room < options.least_room_mm3:
            advice = "lay it under the skin, or make the radius larger"
            raise InputError("scene.filler", f"there is no flesh {near}: {advice}")
        growth = np.cbrt(1.0 + self.ml / ML / room * shares)
        if not growth.max() <= options.filler_growth:
            most = (options.filler_growth**3 - 1.0) * room * ML / shares.max()
            advice = f"at most {most:.2f} ml do; make the path longer or the radius larger"
            reason = f"{self.ml} ml do not fit into the flesh {near}: {advice}"
            limits = {"found_ml": self.ml, "expected_ml": round(most, 3)}
            raise InputError("scene.filler", reason, **limits)
        return replace(before, growth=before.growth * growth)


def under_skin(model: SubjectModel, points: Floats, depths_mm: Floats) -> Floats:
    """Return points (k, 3) at depths (k,) under ``points`` (k, 3) of the face."""
    nearest = model.face[cKDTree(model.skin.vertices[model.face]).query(points)[1]]
    return np.asarray(points - depths_mm[:, None] * vertex_normals(model.skin)[nearest])


@dataclass(frozen=True)
class Scaling:
    """A ``quantity`` of the flesh times ``factor``^u, u being the share of a ``painted`` map (V,).

    The quantity is ``stiffness_factor`` or ``density``.
    """

    quantity: Literal["stiffness_factor", "density"]
    factor: float
    painted: Floats | None = None

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.factor``."""
        most = before.options.factor
        if not 1.0 / most <= self.factor <= most:
            reason = f"a factor lies between {1.0 / most} and {most:g}, not at {self.factor}"
            raise InputError("scene.factor", reason, found=self.factor)
        share = into_volume(before.model, self.painted, before.options.blur_mm)
        changed: Any = {self.quantity: getattr(before, self.quantity) * self.factor**share}
        return replace(before, **changed)


@dataclass(frozen=True)
class Paralysis:
    """``muscles`` (all by default), on one ``side`` (both), keep this ``strength`` (none).

    The name of a whole muscle means all its compartments.

    Their shares in S are multiplied and the rest becomes passive flesh: s_ij -> g_ij s_ij. A side
    is the subject's own; it ends smoothly at the mid-plane, as some muscles cross it.
    """

    muscles: tuple[str, ...] | None = None
    side: Literal["left", "right"] | None = None
    strength: float = 0.0

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.muscle`` and ``scene.strength``."""
        if not 0.0 <= self.strength <= 1.0:
            reason = f"a strength lies between 0 and 1, not at {self.strength}"
            raise InputError("scene.strength", reason, found=self.strength)
        S = before.S
        model = before.model
        rows, columns = S.tocoo().coords
        share = np.isin(columns, self._columns(model.muscle_names)).astype(np.float64)
        if self.side is not None:
            x = model.tet_centres[:, 0] - model.jaw.origin[0]
            outward = x if self.side == "left" else -x
            share *= _smooth(0.5 + 0.5 * outward / before.options.side_mm)[rows]
        kept = S.data * (1.0 - (1.0 - self.strength) * share)
        weakened = sp.csr_array((kept, S.indices, S.indptr), shape=S.shape)
        lost = np.asarray(S.sum(axis=1)) - np.asarray(weakened.sum(axis=1))
        passive = columns == 0
        weakened.data[passive] += lost[rows[passive]]
        return replace(before, S=weakened)

    def _columns(self, names: tuple[str, ...]) -> Ints:
        """Return the columns of S that lose strength."""
        if self.muscles is None:
            return np.arange(1, len(names) + 1)
        found = {name: find_muscles(name, names) for name in self.muscles}
        unknown = [name for name, numbers in found.items() if not numbers]
        if unknown:
            reason = f"the subject has no muscle {unknown[0]!r}; {tell_muscles(unknown[0], names)}"
            raise InputError("scene.muscle", reason, found=unknown, expected=list(names))
        return np.array([k + 1 for numbers in found.values() for k in numbers], dtype=np.int64)


@dataclass(frozen=True)
class Bone:
    """The part of a ``bone`` around a handle moves by ``move_mm`` (3,), less and less outwards.

    ``at`` (3,) is a point on the bone or on the skin before it: the handle is the bone's nearest
    point. At a distance d of it the motion is (1 - d^2 / ``radius_mm``^2)^2 ``move_mm``, for the
    bone, the flesh on it and the teeth in it; eyeballs stay. Positions are those at rest, the jaw
    closed.
    """

    bone: Literal["cranium", "mandible"]
    at: Floats
    radius_mm: float
    move_mm: Floats

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.bone``."""
        model = before.model
        if self.bone not in model.bones:
            raise InputError("scene.bone", f"the subject has no bone {self.bone!r}")
        length = float(np.linalg.norm(self.move_mm))
        least = STEEPEST * length
        if not least / max(self.radius_mm, 1e-9) < 1.0:
            folds = f"a motion of {length:.1f} mm within {self.radius_mm} mm folds the bone"
            reason = f"{folds}; the radius must be above {least:.1f} mm"
            raise InputError("scene.bone", reason, expected_mm=round(least, 1))
        surface = model.bones[self.bone]
        handle = self._handle(surface, before.options.handle_mm)

        def motion(points: Floats) -> Floats:
            share = _bump(np.linalg.norm(points - handle, axis=1), self.radius_mm)
            return np.asarray(share[:, None] * self.move_mm)

        of_bone, of_skin = _vertices(model, self.bone)
        bones = before.bones.copy()
        skin = model.skin.vertices.copy()
        bones[of_bone] += motion(model.rest[of_bone] + bones[of_bone])
        skin[of_skin] += motion(skin[of_skin])
        moved = surface.with_vertices(surface.vertices + motion(surface.vertices))
        anatomy = replace(
            model, bones={**model.bones, self.bone: moved}, skin=model.skin.with_vertices(skin)
        )
        return replace(before, model=anatomy, bones=bones)

    def _handle(self, surface: Surface, near_mm: float) -> Floats:
        """Return the bone's point (3,) nearest to ``at``."""
        at = np.ascontiguousarray(self.at, dtype=np.float64)[None]
        squared, _, nearest = igl.point_mesh_squared_distance(at, surface.vertices, surface.faces)
        away = float(np.sqrt(squared[0]))
        if away > near_mm:
            place = f"the handle lies {away:.0f} mm off the {self.bone}"
            limits = {"found_mm": round(away, 1), "expected_mm": near_mm}
            raise InputError("scene.bone", f"{place}, {near_mm:.0f} at most can be", **limits)
        return np.asarray(nearest[0])


def _vertices(model: SubjectModel, bone: str) -> tuple[Ints, Ints]:
    """Return the flesh's vertices on a bone, and the skin's that stay with it."""
    if bone == "mandible":
        return model.mandible, model.attached_mandible
    eyes = [model.region(f"{side}_eyeball") for side in ("left", "right")]
    # skin beyond the flesh follows the flesh that the bone moves
    follows = [model.embedded, LooseSkin(model).ids]
    others = np.concatenate([*follows, model.attached_mandible, *eyes])
    with_cranium = np.setdiff1d(np.arange(len(model.skin.vertices)), others)
    return np.concatenate([model.cranium, model.sliding]), with_cranium


def into_volume(
    model: SubjectModel, painted: Floats | None, blur_mm: float = 2.0, depth_mm: float | None = None
) -> Floats:
    """Return a map painted on the skin (V,) as shares of the tets (n,); None is 1 everywhere.

    u on the tets' vertices minimises the integral of |grad u|^2 over the flesh plus that of
    (u - painted)^2 / ``blur_mm`` over the skin of face and neck: heat that comes from there and
    leaves nowhere. A ``depth_mm`` adds the integral of u^2 / depth^2: u falls to 1/e on that way
    inward. Raises ``scene.map`` for a map of another skin or with values outside of [0, 1].
    """
    if painted is None:
        return np.ones(len(model.tets))
    _check(model, painted)
    painted_skin = np.union1d(model.face, model.region("neck"))
    outer = np.isin(model.embedded, painted_skin)
    skin = model.embedding[outer]
    area = vertex_areas(model.skin.vertices, model.skin.faces)[model.embedded[outer]] / blur_mm
    heat = painted[model.embedded[outer]]
    gradients, sizes = shape_gradients(model.rest, model.tets)
    system = laplacian(gradients, sizes, model.tets, len(model.rest))
    if depth_mm is not None:
        heat = heat * (1.0 + blur_mm / depth_mm)  # what flows inward is missing on the skin
        lumped = np.bincount(model.tets.ravel(), np.repeat(sizes / 4.0, 4), len(model.rest))
        system += sp.diags_array(lumped / depth_mm**2)
    # a trace of stiffness for flesh in no contact with the face, which gets none of it
    u = HarmonicExtension(system, rows=skin, weights=area, trace=1e-9)(targets=heat)
    return np.asarray(np.clip(u, 0.0, 1.0)[model.tets].mean(axis=1))


def spots(model: SubjectModel, centres: Floats, radius_mm: float) -> Floats:
    """Return a map (V,) of soft round spots around points ``centres`` (k, 3), in mm.

    It is (1 - d^2 / radius^2)^2 at a distance d of the nearest centre.
    """
    away = model.skin.vertices[:, None] - centres[None]
    return _bump(np.linalg.norm(away, axis=2).min(axis=1, initial=np.inf), radius_mm)


def _check(model: SubjectModel, painted: Floats) -> None:
    expected = len(model.skin.vertices)
    if painted.shape != (expected,):
        wanted = f"a map has one value for each of the skin's {expected} vertices"
        counts = {"expected": expected, "found": list(painted.shape)}
        raise InputError("scene.map", f"{wanted}, not the shape {painted.shape}", **counts)
    wrong = np.flatnonzero(~((painted >= 0.0) & (painted <= 1.0)))
    if len(wrong):
        first = f"{len(wrong)} do not, the first is {painted[wrong[0]]} at vertex {wrong[0]}"
        reason = f"a map's values lie between 0 and 1; {first}"
        raise InputError("scene.map", reason, vertex=int(wrong[0]))


def _bump(away: Floats, radius: float) -> Floats:
    """Return (1 - d^2 / radius^2)^2 for distances (k,), zero beyond the radius."""
    return np.asarray(np.maximum(1.0 - (away / radius) ** 2, 0.0) ** 2)


def _smooth(t: Floats) -> Floats:
    """Return the smooth step from 0 at t = 0 to 1 at t = 1."""
    t = np.clip(t, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
