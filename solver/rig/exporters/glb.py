"""``rig.glb``: the skin with one morph target per expression, after the glTF 2.0 specification."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from solver.rig.frames.gltf import DEFAULTS, ERROR_ATTRIBUTE, in_turn, worst_error, write_face
from solver.rig.frames.gltf import MorphTargetOptions as Options
from solver.rig.frames.read_back import compare_expressions, read_glb
from solver.rig.rig import Rig

FILE = "rig.glb"
MEDIA_TYPE = "model/gltf-binary"
WITH_EVERY_RIG = True


def write(rig: Rig, path: Path, options: Options = DEFAULTS) -> None:
    """Write the neutral skin (v, 3), its expressions as morph targets and an animation, in metres.

    They are those of the rig's default system. ``_ERROR_MM`` is the greatest distance to the scans
    over all of them, mm, 0 where nothing was measured.
    """
    shapes = {fit.name: fit.skin for fit in rig.shown}
    worst = worst_error(rig.shown, len(rig.model.skin.vertices))
    animate = partial(in_turn, options=options)
    write_face(path, rig.model.skin, shapes, animate, {ERROR_ATTRIBUTE: worst}, options)


def read_back(rig: Rig, path: Path, _options: Options = DEFAULTS) -> dict[str, Any]:
    """Return how far the file's skins are off the rig's."""
    return compare_expressions(path, read_glb(path).expressions(), rig.skins())
