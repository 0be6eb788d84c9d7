"""Write what felupe makes of a bar of Mooney-Rivlin flesh: ``python -m tests.make_felupe_bar``.

felupe (11.3.0, GPL, by A. Dutzler) is no dependency of ours: ``pip install felupe`` for this run
alone. The law is put together from its own parts, the invariants with automatic derivatives and
the volumetric part, and nothing of ours is in it but the mesh. tests/fixtures/README.md says what
the file has; tests/solver/mechanics/test_flesh.py compares.
"""

from __future__ import annotations

import felupe
import numpy as np

from tests.fixtures import FELUPE_FILE
from tests.solver.block import grid

MU = 3000.0
BULKS = (20.0 / 3.0, 200.0)  # times mu: our flesh's, and next to incompressible
# degrees about the bar's axis and about z, and mm along the axes, of the end that is moved
MOTIONS = ((35.0, 0.0, 9.0, 6.0, 0.0), (0.0, 25.0, -7.0, 3.0, -2.0))
STEPS = 20


def main() -> None:
    """Solve each motion with each bulk modulus, and write places and nodal forces."""
    vertices, tets = grid((6, 2, 2), (30.0, 10.0, 10.0))
    cases = [(bulk * MU, motion) for bulk in BULKS for motion in MOTIONS]
    found = [_solve(vertices, tets, *case) for case in cases]
    np.savez_compressed(
        FELUPE_FILE,
        felupe=felupe.__version__,
        vertices=vertices,
        tets=tets,
        mu=MU,
        bulk=[bulk for bulk, _ in cases],
        places=[places for places, _ in found],
        forces=[forces for _, forces in found],
    )


def _solve(vertices, tets, bulk, motion):
    """Return places (p, 3) and nodal forces (p, 3), the end being moved in even steps."""
    region = felupe.RegionTetra(felupe.Mesh(vertices, tets, "tetra"))
    field = felupe.FieldContainer([felupe.Field(region, dim=3)])
    isochoric = felupe.Hyperelastic(felupe.mooney_rivlin, C10=MU / 4.0, C01=MU / 4.0)
    body = felupe.SolidBody(isochoric & felupe.Volumetric(bulk=bulk), field)
    near, far = (vertices[:, 0] == end for end in (0.0, 30.0))
    for part in np.linspace(0.0, 1.0, STEPS + 1)[1:]:
        goal = _moved(vertices[far], part * np.array(motion)) - vertices[far]
        bounds = {"near": felupe.Boundary(field[0], mask=near)}
        for axis in range(3):
            others = tuple(int(each != axis) for each in range(3))
            value = goal[:, axis]
            bounds[str(axis)] = felupe.Boundary(field[0], mask=far, value=value, skip=others)
        dof0, dof1 = felupe.dof.partition(field, bounds)
        ends = {"dof0": dof0, "dof1": dof1, "ext0": felupe.dof.apply(field, bounds, dof0)}
        felupe.newtonraphson(items=[body], **ends, tol=1e-12, verbose=0)
    forces = body.results.force.toarray().reshape(-1, 3)
    return vertices + field[0].values, forces


def _moved(points, motion):
    """Return the end's points turned about its middle and shifted."""
    (c, d), (e, f) = ((np.cos(each), np.sin(each)) for each in np.radians(motion[:2]))
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -d], [0.0, d, c]])
    about_z = np.array([[e, -f, 0.0], [f, e, 0.0], [0.0, 0.0, 1.0]])
    middle = points.mean(axis=0)
    return (points - middle) @ (about_z @ about_x).T + middle + motion[2:]


if __name__ == "__main__":
    main()
