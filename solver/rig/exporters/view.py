"""``view.bin``: the skin of a rig for a page that shows it, and that page for a notebook.

docs/reference/rig-format.md describes it. Displacements are in half precision, as in
``inside.bin``.
"""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from solver.anatomy.muscle_weights import muscle_volumes
from solver.fitting.contraction import STILL
from solver.rig.exporters import NO_OPTIONS
from solver.rig.exporters import NoOptions as Options
from solver.rig.frames.read_back import NEUTRAL, compare_expressions
from solver.rig.rig import Rig
from solver.storage import read_container, write_container

FILE = "view.bin"
MEDIA_TYPE = "application/octet-stream"
WITH_EVERY_RIG = True


def write(rig: Rig, path: Path, _options: Options = NO_OPTIONS) -> None:
    """Write the skin in every expression, the scans and the distances between them."""
    figures = rig.known_figures()
    neutral = rig.model.skin.vertices
    told = [figures["expressions"][fit.name] for fit in rig.expressions]
    names, jaw = rig.model.muscle_names, rig.model.jaw
    flesh = muscle_volumes(rig.model.rest, rig.model.tets, rig.weights).tolist()
    header = {
        "expressions": [
            {"name": fit.name, **{key: each[key] for key in ("mean_mm", "p95_mm", "max_mm")}}
            for fit, each in zip(rig.expressions, told, strict=True)
        ],
        "muscles": list(names),
        "wholes": list(rig.model.muscle_groups),
        "flesh_mm3": flesh,
        "still": [-STILL.lengthened, STILL.least],
        "sagittal": {"at": jaw.origin.tolist(), "across": jaw.axes[0].tolist()},
    }
    stretches = [[each["muscles"][name]["fibres"] for name in names] for each in told]
    arrays: dict[str, np.ndarray] = {
        "neutral": neutral.astype(np.float32),
        "faces": rig.model.skin.faces.astype(np.uint32),
        "activation": np.array(stretches, np.float32).reshape(len(told), len(names)),
    }
    for k, fit in enumerate(rig.expressions):
        arrays[f"skin/{k}"] = (fit.skin - neutral).astype(np.float16)
        arrays[f"scan/{k}"] = (fit.target - neutral).astype(np.float16)
        arrays[f"error/{k}"] = fit.error_mm.astype(np.float16)
    write_container(path, header, arrays)


def read_back(rig: Rig, path: Path, _options: Options = NO_OPTIONS) -> dict[str, Any]:
    """Return how far the file's skins are off the rig's."""
    archive = read_container(path)
    arrays, told = archive.arrays, archive.header["expressions"]
    neutral = arrays["neutral"]
    shown = {each["name"]: neutral + arrays[f"skin/{k}"] for k, each in enumerate(told)}
    return compare_expressions(path, {NEUTRAL: neutral, **shown}, rig.skins())


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
        write(rig, content := Path(folder) / FILE)
        packed = b64encode(content.read_bytes()).decode()
    page = Path(__file__).with_name("viewer.html").read_text(encoding="utf-8")
    return Notebook(page.replace("@CONTENT@", packed), height)
