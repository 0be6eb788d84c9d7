"""How deep a point lies under the skin, and which way is deeper."""

from __future__ import annotations

import igl
import numpy as np

from solver.surface import Floats, Ints, Surface


class SkinDepth:
    """Signed distance to a skin whose holes (mouth, lids, neck) are closed by fans.

    With open holes the teeth would count as outside.
    """

    def __init__(self, skin: Surface) -> None:
        caps = [_fan(loop) for loop in boundary_loops(skin.faces)]
        loops = boundary_loops(skin.faces)
        centres = [skin.vertices[loop].mean(axis=0) for loop in loops]
        count = len(skin.vertices)
        caps = [np.where(cap < 0, count + number, cap) for number, cap in enumerate(caps)]
        self._vertices = np.vstack([skin.vertices, *[centre[None] for centre in centres]])
        self._faces = np.vstack([skin.faces, *caps])
        self._open = skin.faces
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._open)

    def inside(self, points: Floats) -> np.ndarray:
        """Return (n,) True where a point is under the skin."""
        winding = igl.fast_winding_number(self._vertices, self._faces, points)
        return np.asarray(winding) > 0.5

    def __call__(self, points: Floats) -> tuple[Floats, Floats]:
        """Return depths (n,) in mm, negative outside, and unit directions (n, 3) that go deeper."""
        squared, _, closest = self._tree.squared_distance(self._vertices, self._open, points)
        away = points - closest
        distance = np.sqrt(np.asarray(squared).ravel())
        sign = np.where(self.inside(points), 1.0, -1.0)
        direction = sign[:, None] * away / np.maximum(distance, 1e-9)[:, None]
        return sign * distance, direction


def boundary_loops(faces: Ints) -> list[Ints]:
    """Return the closed loops of boundary vertices of a surface, in the direction of its edges."""
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    twins = {(int(a), int(b)) for a, b in edges}
    following = {int(a): int(b) for a, b in edges if (int(b), int(a)) not in twins}
    loops = []
    while following:
        start, vertex = following.popitem()
        loop = [start]
        while vertex != start:
            loop.append(vertex)
            vertex = following.pop(vertex)
        loops.append(np.array(loop))
    return loops


def _fan(loop: Ints) -> Ints:
    # -1 stands for the centre, which has no number yet; the order closes the surface consistently.
    return np.column_stack([np.roll(loop, -1), loop, np.full(len(loop), -1)])
