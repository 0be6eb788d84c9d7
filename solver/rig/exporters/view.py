"""``view.bin``: the skin of a rig for a page that shows it, and that page for a notebook.

docs/reference/rig-format.md describes it. Displacements are in half precision, as in
``inside.bin``. Other systems of a rig have a file each, ``view_T.bin`` ....
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from solver.anatomy.muscle_weights import muscle_volumes
from solver.anatomy.tetrahedra import volumes
from solver.errors import InputError, quote
from solver.fitting.contraction import STILL, Contraction
from solver.rig.expression import ExpressionFit
from solver.rig.frames.read_back import NEUTRAL, compare_expressions
from solver.rig.report.measures import distances
from solver.rig.rig import Rig
from solver.storage import read_container, write_container

FILE = "view.bin"
MEDIA_TYPE = "application/octet-stream"
WITH_EVERY_RIG = True


@dataclass(frozen=True)
class Options:
    """Whose expressions are written."""

    system: str = "S"  # the rig's muscles; or one of its systems


DEFAULTS = Options()


def write(rig: Rig, path: Path, options: Options = DEFAULTS) -> None:
    """Write the skin in every expression, the scans and the distances between them.

    Raises :class:`InputError` (``export.options``) for a system that the rig does not have.
    """
    model = rig.model
    fits = _fits(rig, options.system)
    neutral = model.skin.vertices
    jaw = model.jaw
    contraction = Contraction.of(model, volumes(model.rest, model.tets), rig.weights)
    flesh = muscle_volumes(model.rest, model.tets, rig.weights).tolist()
    header = {
        "expressions": [
            {"name": fit.name, **distances(fit.measured_error(model.face))} for fit in fits
        ],
        "muscles": list(model.muscle_names),
        "wholes": list(model.muscle_groups),
        "flesh_mm3": flesh,
        "still": [-STILL.lengthened, STILL.least],
        "sagittal": {"at": jaw.origin.tolist(), "across": jaw.axes[0].tolist()},
    }
    stretches = [1.0 - contraction(fit.activations) for fit in fits]
    arrays: dict[str, np.ndarray] = {
        "neutral": neutral.astype(np.float32),
        "faces": model.skin.faces.astype(np.uint32),
        "activation": np.array(stretches, np.float32).reshape(len(fits), model.muscle_count),
    }
    for k, fit in enumerate(fits):
        arrays[f"skin/{k}"] = (fit.skin - neutral).astype(np.float16)
        arrays[f"scan/{k}"] = (fit.target - neutral).astype(np.float16)
        arrays[f"error/{k}"] = fit.error_mm.astype(np.float16)
    write_container(path, header, arrays)


def _fits(rig: Rig, system: str) -> Sequence[ExpressionFit]:
    """Return the expressions of a system."""
    known = rig.fits_by_system
    if system not in known:
        message = f"the rig has no system {quote(system)}: it has {', '.join(known)}"
        raise InputError("export.options", message, found=quote(system), expected=[*known])
    return known[system]


def read_back(rig: Rig, path: Path, options: Options = DEFAULTS) -> dict[str, Any]:
    """Return how far the file's skins are off the rig's."""
    skins = {fit.name: fit.skin for fit in _fits(rig, options.system)}
    archive = read_container(path)
    arrays = archive.arrays
    told = archive.header["expressions"]
    neutral = arrays["neutral"]
    shown = {each["name"]: neutral + arrays[f"skin/{k}"] for k, each in enumerate(told)}
    wanted = {NEUTRAL: rig.model.skin.vertices, **skins}
    return compare_expressions(path, {NEUTRAL: neutral, **shown}, wanted)


@dataclass(frozen=True)
class Notebook:
    """A page as a notebook's cell shows it, in a frame of its own."""

    page: str
    height: int

    def _repr_html_(self) -> str:
        look = f"width: 100%; height: {self.height}px; border: 0"
        return (
            f'<iframe sandbox="allow-scripts" style="{look}" srcdoc="{escape(self.page)}"></iframe>'
        )


def notebook(rig: Rig, height: int) -> Notebook:
    """Return a page with the skin of a rig in it, ``height`` pixels high."""
    with TemporaryDirectory() as folder:
        write(rig, content := Path(folder) / FILE, Options(rig.default_system))
        packed = b64encode(content.read_bytes()).decode()
    page = Path(__file__).with_name("viewer.html").read_text(encoding="utf-8")
    return Notebook(page.replace("@CONTENT@", packed), height)
