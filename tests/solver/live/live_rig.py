"""A small rig with all that a live session needs, made in seconds: its skin moves by the shapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from solver.fitting.expression_basis import ExpressionBasis
from solver.kinds.live_messages import FollowedFrame, GivenFrame
from solver.live.session import LiveSession
from solver.live.skin import LiveSkin
from solver.rig.frames.skin_basis import ReducedSkin
from solver.rig.preview.sliders import Control, Sliders
from solver.templates.builtin.build import builtin_template
from tests.fixtures import small_rig


def follow(session: LiveSession, frame: GivenFrame, dropped: int = 0) -> FollowedFrame:
    """Return a frame as a session follows it."""
    return session.step(frame, session.read(frame), dropped)[0]


def live_files(folder: Path) -> dict[str, Path]:
    """Write a rig, a basis of expressions and a reduced skin, and return them by their roles."""
    rig = small_rig()
    face = rig.face()
    found = builtin_template().shapes
    assert found is not None
    names = found.expression_names
    shapes = found.expressions
    layout = face.layout
    directions = np.zeros((layout.size, len(names)))
    opening = layout.places(face.joint.block.name)[0]
    directions[opening, names.index("jawOpen")] = 0.25
    sliders = Sliders(
        tuple(Control(name, "expression", name) for name in names),
        face.rest_pose(),
        directions,
        {},
        face.jaw,
    )
    count = len(names)
    scale = np.abs(shapes).max(axis=(1, 2))
    modes = (shapes / scale[:, None, None]).astype(np.float16)
    none = np.zeros((count, count * (count + 1) // 2), np.float32)
    skin = ReducedSkin(modes, np.diag(scale).astype(np.float32), none)
    files = {
        "rig": folder / "rig.npz",
        "expression_basis": folder / "basis.npz",
        "live_skin": folder / "skin.npz",
    }
    rig.save(files["rig"])
    changes = tuple(column[None] for column in directions.T)
    ExpressionBasis(shapes, changes).save(files["expression_basis"], face)
    spare = np.zeros((0, *shapes.shape[1:]), np.float16)
    LiveSkin(sliders, skin, spare, {"mean": 0.1}).save(files["live_skin"], face, shapes)
    return files
