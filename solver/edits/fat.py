"""Fattening and slimming: flesh that grows without stress, as far as it is not muscle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from solver.edits.edit import Edited
from solver.edits.maps import into_volume
from solver.errors import InputError
from solver.mechanics.flesh import shape_gradients
from solver.model import SubjectModel
from solver.surface import Floats, adjacency, vertex_normals

# Ends of a model's flesh where a person's goes on: at its cuts, and along the neck.


def off_the_ends(model: SubjectModel, fade_mm: float = 20.0) -> Floats:
    """Return 0 for tets (n,) where the model ends, and 1 from ``fade_mm`` on."""
    ends = np.vstack([model.rest[model.cut], _border(model)])
    if not len(ends):
        return np.ones(len(model.tets))
    centres = model.rest[model.tets].mean(axis=1)
    t = np.minimum(cKDTree(ends).query(centres)[0] / fade_mm, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def _border(model: SubjectModel) -> Floats:
    """Return the skin's points (k, 3) that follow the flesh beside some that do not.

    Of their lines that is the one around the whole face; others lie in mouth, nose and eyes.
    """
    follows = np.zeros(len(model.skin.vertices), dtype=bool)
    follows[model.embedded] = True
    count = follows[model.skin.faces].sum(axis=1)
    mixed = model.skin.faces[(count > 0) & (count < 3)]
    _, part = connected_components(adjacency(mixed, len(follows)), directed=False)
    lines = [model.skin.vertices[(part == number) & follows] for number in np.unique(part[mixed])]
    return max(lines, key=lambda line: float(np.ptp(line, axis=0).max()), default=np.zeros((0, 3)))


@dataclass(frozen=True)
class Fat:
    """Growth f_i = f_min (1 - s_i0) + f_max s_i0 of F_p = f I, where a map says.

    The equation is in ARCHITECTURE.md (fat).

    Muscle grows by ``f_min``, passive flesh by ``f_max``; s_i0 is S's passive share of a tet.
    (0.9, 1.0) is slim, (1.0, 1.2) fat. A ``painted`` map (V,), see :mod:`solver.edits.maps`, draws
    f towards 1, and so do the ends of the model's flesh. Where f > 1 the stiffness is
    divided by f^``softening``, as it is the same tissue in more volume; the exponent is ours.
    """

    f_min: float
    f_max: float
    painted: Floats | None = None
    softening: float = 3.0

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.fat`` for a growth out of all measure."""
        options = before.options
        low, high = options.fat_growth
        for factor in (self.f_min, self.f_max):
            if not low <= factor <= high:
                raise InputError(
                    "scene.fat",
                    f"flesh grows by a factor between {low} and {high}, not {factor}",
                    found=factor,
                )
        passive = before.S[:, [0]].toarray()[:, 0]
        whole = self.f_min * (1.0 - passive) + self.f_max * passive
        share = into_volume(before.model, self.painted, options.blur_mm)
        share = share * off_the_ends(before.model, options.fade_mm)
        growth = 1.0 + (whole - 1.0) * share
        softer = np.maximum(growth, 1.0) ** -self.softening
        return replace(
            before, growth=before.growth * growth, stiffness_factor=before.stiffness_factor * softer
        )


# Filler: a volume that is injected along the path of a needle.


MM3_PER_ML = 1000.0  # mm^3 in a ml


@dataclass(frozen=True)
class Filler:
    """So many ``ml`` along a ``path`` (k, 3) in mm, in the person's frame at rest.

    The flesh grows by f of F_p = f I with f^3 = 1 + alpha exp(-d^2 / (2 radius^2)), d being the
    distance to the path; alpha is such that the flesh, were it free, grew by the given volume.
    """

    path: Floats
    ml: float
    radius_mm: float = 2.5

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.filler`` where there is no room for it."""
        model, options = before.model, before.options
        if not (self.ml > 0.0 and self.radius_mm > 0.0 and len(self.path)):
            raise InputError(
                "scene.filler", "a filler needs a path, and a volume and a radius above 0"
            )
        away = distance_to_path(model.rest[model.tets].mean(axis=1), self.path)
        shares = np.exp(-0.5 * (away / self.radius_mm) ** 2)
        volumes = shape_gradients(model.rest, model.tets)[1] * before.growth**3
        room = float(volumes @ shares)
        if room < options.least_room_mm3:
            raise InputError(
                "scene.filler",
                f"there is no flesh within {self.radius_mm} mm of the path: lay it under the skin, "
                "or make the radius larger",
            )
        growth = np.cbrt(1.0 + self.ml * MM3_PER_ML / room * shares)
        if not growth.max() <= options.filler_growth:
            most = (options.filler_growth**3 - 1.0) * room / MM3_PER_ML / shares.max()
            raise InputError(
                "scene.filler",
                f"{self.ml} ml do not fit into the flesh within {self.radius_mm} mm of the path: "
                f"at most {most:.2f} ml do; make the path longer or the radius larger",
                found_ml=self.ml,
                expected_ml=round(most, 3),
            )
        return replace(before, growth=before.growth * growth)


def under_skin(model: SubjectModel, points: Floats, depths_mm: Floats) -> Floats:
    """Return points (k, 3) at depths (k,) under ``points`` (k, 3) of the face."""
    skin = model.skin.vertices[model.face]
    nearest = model.face[cKDTree(skin).query(points)[1]]
    return np.asarray(points - depths_mm[:, None] * vertex_normals(model.skin)[nearest])


def distance_to_path(points: Floats, path: Floats) -> Floats:
    """Return the distance (n,) of points (n, 3) to a polyline (k, 3); one point is one, too."""
    starts, ends = path[: max(len(path) - 1, 1)], path[min(1, len(path) - 1) :]
    nearest = np.full(len(points), np.inf)
    for start, end in zip(starts, ends, strict=True):
        along = end - start
        part = (points - start) @ along / max(float(along @ along), 1e-12)
        foot = start + np.clip(part, 0.0, 1.0)[:, None] * along
        nearest = np.minimum(nearest, np.linalg.norm(points - foot, axis=1))
    return nearest


# Flesh that is stiffer or softer, heavier or lighter, where a map says.


@dataclass(frozen=True)
class Stiffening:
    """Stiffness times ``factor``^u, u being the tet's share of a ``painted`` map (V,)."""

    factor: float
    painted: Floats | None = None

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.factor``."""
        change = _change(before, self.factor, self.painted)
        return replace(before, stiffness_factor=before.stiffness_factor * change)


@dataclass(frozen=True)
class Density:
    """Density times ``factor``^u, u being the tet's share of a ``painted`` map (V,)."""

    factor: float
    painted: Floats | None = None

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.factor``."""
        change = _change(before, self.factor, self.painted)
        return replace(before, density=before.density * change)


def _change(before: Edited, factor: float, painted: Floats | None) -> Floats:
    most = before.options.factor
    if not 1.0 / most <= factor <= most:
        raise InputError(
            "scene.factor",
            f"a factor lies between {1.0 / most} and {most:g}, not at {factor}",
            found=factor,
        )
    share: Floats = factor ** into_volume(before.model, painted, before.options.blur_mm)
    return share
