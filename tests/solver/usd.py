"""Play back what a USD file of a face shows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from solver.surface import Floats


def played(path: Path) -> Callable[[str, float], Floats]:
    """Return what gives a mesh's points, mm, at a time code: UsdSkel's own skinning, baked."""
    pytest.importorskip("pxr", reason="USD is not installed: pip install 'myoface[usd]'")
    from pxr import Gf, Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.Open(str(path))
    span = Gf.Interval(stage.GetStartTimeCode(), stage.GetEndTimeCode())
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetDefaultPrim()), span)

    def points(name: str, frame: float) -> Floats:
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/Face/{name}"))
        place = np.array(mesh.ComputeLocalToWorldTransform(frame))
        return np.array(mesh.GetPointsAttr().Get(frame)) @ place[:3, :3] + place[3, :3]

    return points
