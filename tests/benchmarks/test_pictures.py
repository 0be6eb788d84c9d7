from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.pictures import Compared, side_by_side
from solver.fitting.face import Face, Pose
from tests.solver.block import block_model


def test_a_fit_that_is_off_is_redder(tmp_path: Path) -> None:
    model = block_model()
    face = Face(model)
    rest = face.rest
    a = rest.pose.a.copy()
    a[0, 0] = 0.6
    moved = face.continuation(rest, Pose(a, rest.pose.b))
    scan = face.whole_skin(rest.x, rest.pose.b)
    path = tmp_path / "new" / "fits.png"
    side_by_side(path, face, "Block", {"rest": Compared(scan, {"S": rest, "P": moved})})
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    width = pixels.shape[1] // 5
    redness = (pixels[..., 0] - pixels[..., 2]).reshape(len(pixels), -1)
    near, off = (redness[100:400, column * width : (column + 1) * width] for column in (2, 4))
    assert off.max() > near.max() + 50
