"""A person's own scans as shapes beside those of the template.

The template's shapes and a jaw come near a scan, and leave some of it: what a smile has that is
this person's alone. That is one more shape. With m(w, j) the sum of plain shapes that fits the
scan t best, b its jaw and P the way back through the skinning (:mod:`solver.tracks.shapes`),

    B = P(t) - P(m(w, j)),    b_k = j,

so that the weights w with 1 for the new shape are the scan. Where a scan has seen nothing, the
shape asks for nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from solver.fitting.objective import SkinDistance, Target
from solver.mechanics.boundary import FreeJaw
from solver.meshio.registered import RegisteredScan
from solver.model import SubjectModel
from solver.tracks.basis import MuscleTracks
from solver.tracks.fit import fit
from solver.tracks.plain import PlainFace
from solver.tracks.shapes import ShapeOnTop, before_skinning, skinning_of_skin

PREFIX = "own_"  # of their names: scans may be called as the template's shapes are


@dataclass(frozen=True)
class OwnShapes:
    """The tracks with a person's own shapes, and what sums without them leave of each scan."""

    tracks: MuscleTracks
    left_mm: dict[str, float]  # by the shape's name, mean over the face


def with_own_shapes(
    model: SubjectModel, tracks: MuscleTracks, scans: Mapping[str, RegisteredScan]
) -> OwnShapes:
    """Return a model's ``tracks`` with a shape for each of its registered ``scans`` by name."""
    face = PlainFace(model, tracks)
    on_skin = skinning_of_skin(model, tracks.skinning)
    shapes = []
    left = {}
    for name, scan in scans.items():
        target = Target.from_points(scan.vertices[model.face], scan.confidence[model.face])
        state = fit(face, SkinDistance(face.face, target)).point
        skin = face.skin(state)
        turned = on_skin, FreeJaw(model.jaw).matrix(state.pose.jaw)
        scanned, usual = (
            before_skinning(points[model.embedded], *turned) for points in (scan.vertices, skin)
        )
        weights, jaw = np.split(state.q, [len(tracks.names)])
        trust = scan.confidence[model.embedded]
        shapes.append(ShapeOnTop(PREFIX + name, weights, jaw, scanned - usual, trust))
        left[PREFIX + name] = float(np.nanmean(target.distances(skin[model.face])))
    return OwnShapes(tracks.with_shapes(model, shapes), left)
