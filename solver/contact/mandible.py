"""The mandible by four of its vertices: what rides on it needs only x, not b."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.model import SubjectModel
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class Mandible:
    """Four vertices ``corners`` (4,) that span the mandible, and where they are at ``rest`` (4, 3).

    A point that rides on it is p = sum_k w_k x_k, with affine shares w that do not change.
    """

    corners: Ints
    rest: Floats

    @classmethod
    def of(cls, model: SubjectModel) -> Mandible:
        """Choose vertices that are far apart: each the farthest from the span of those before."""
        points = model.rest[model.mandible]
        span = points - points.mean(axis=0)
        chosen = [int(np.argmax(np.linalg.norm(span, axis=1)))]
        span = points - points[chosen[0]]
        for _ in range(3):
            distance = np.linalg.norm(span, axis=1)
            chosen.append(int(np.argmax(distance)))
            along = span[chosen[-1]] / distance[chosen[-1]]
            span = span - np.outer(span @ along, along)
        corners: Ints = model.mandible[chosen]
        return cls(corners, model.rest[corners])

    def shares(self, points: Floats) -> Floats:
        """Return the shares w (k, 4) of points (k, 3), the mandible being at rest."""
        return _affine(points, self.rest)[0]

    def seen(self, points: Floats, x: Floats) -> tuple[Floats, Floats, Floats]:
        """See points (k, 3) of the head from the mandible, the vertices being at x (p, 3).

        Returns where they were with the mandible at rest (k, 3); their shares w (k, 4); and the
        matrix (3, 3) that takes a step of a point, or of it off its place on the mandible,
        dp - sum_k w_k dx_k, to that of the first.
        """
        shares, by_point = _affine(points, x[self.corners])
        return shares @ self.rest, shares, self.rest.T @ by_point


def _affine(points: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """Return the shares (k, 4) of points in a tet's corners (4, 3), and dw/dp (4, 3)."""
    inverse = np.linalg.inv(np.vstack([corners.T, np.ones(4)]))
    return points @ inverse[:, :3].T + inverse[:, 3], inverse[:, :3]
