"""``systems.glb``: a rig's systems side by side, a face of each with its expressions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from solver.errors import InputError
from solver.rig.frames.gltf import MorphTargetOptions, worst_error, write_faces
from solver.rig.frames.read_back import NEUTRAL, MorphedSkin, compare_expressions, read_glb
from solver.rig.rig import Rig
from solver.surface import Floats

FILE = "systems.glb"
MEDIA_TYPE = "model/gltf-binary"
WITH_EVERY_RIG = False


@dataclass(frozen=True)
class Options(MorphTargetOptions):
    """Options of shapes, and where the faces stand."""

    apart: float = 1.1  # from face to face, in widths of the skin; 0 puts all in one place


DEFAULTS = Options()


def write(rig: Rig, path: Path, options: Options = DEFAULTS) -> None:
    """Write nodes ``face.S``, ``face.T`` ... that share the neutral skin, and one animation of all.

    Raises :class:`InputError` (``export.options``) for a negative distance.
    """
    if options.apart < 0.0:
        raise InputError("export.options", f"apart is {options.apart:g}, not 0 or more")
    skin = rig.model.skin
    errors = {
        name: worst_error(fits, len(skin.vertices)) for name, fits in rig.fits_by_system.items()
    }
    across = skin.vertices[:, 0]
    apart_mm = options.apart * float(across.max() - across.min())
    write_faces(path, skin, _shapes(rig), errors, apart_mm, options)


def read_back(rig: Rig, path: Path, _options: Options = DEFAULTS) -> dict[str, Any]:
    """Return how far the file's skins are off the rig's, with the system that is furthest."""
    return compare_systems(rig, path, lambda _, node: read_glb(path, node))


def compare_systems(
    rig: Rig, path: Path, read: Callable[[str, int], MorphedSkin]
) -> dict[str, Any]:
    """Return how far a file's skins are off the rig's, with the system that is furthest.

    ``read`` gives what the file has of a system, by its letter and its number in the rig.
    """
    worst: dict[str, Any] = {"max_mm": -1.0}
    for number, (system, shapes) in enumerate(_shapes(rig).items()):
        wanted = {NEUTRAL: rig.model.skin.vertices, **shapes}
        found = compare_expressions(path, read(system, number).expressions(), wanted)
        if found["max_mm"] > worst["max_mm"]:
            worst = {**found, "system": system}
    return worst


def _shapes(rig: Rig) -> dict[str, dict[str, Floats]]:
    """Return the skins of every system's expressions."""
    return {name: {fit.name: fit.skin for fit in fits} for name, fits in rig.fits_by_system.items()}
