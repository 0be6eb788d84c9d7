"""The reduced skin of a live session: a template's expressions as sliders, and modes they move.

The skin is the neutral + amounts @ basis, and amounts are quadratic in the sliders' values
(:class:`~solver.rig.frames.skin_basis.ReducedSkin`). It is made once for a rig, which takes
minutes, and kept as ``live_skin.npz``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from solver.fitting.expression_basis import ExpressionBasis, basis_identity
from solver.fitting.face import Face
from solver.kinds import FILES
from solver.model import SubjectModel
from solver.rig.frames.skin_basis import ReducedSkin
from solver.rig.preview import PreviewOptions, make_live_preview
from solver.rig.preview.sliders import Control, Sliders
from solver.storage import Archive
from solver.surface import Floats

FILE = "live_skin.npz"
FORMAT = FILES[FILE].format
TOLERANCE = 1e-5  # residual of an equilibrium: within a thousandth of a mm


@dataclass(frozen=True)
class LiveSkinOptions:
    """How much is spent on a reduced skin."""

    seed: int = 1
    seconds: float = 900.0
    preview: PreviewOptions = field(default_factory=PreviewOptions)


LIVE_SKIN = LiveSkinOptions()


@dataclass(frozen=True, eq=False)
class LiveSkin:
    """Sliders with the skin that they move; ``error_mm`` are figures of poses not learned from."""

    sliders: Sliders
    skin: ReducedSkin
    error_mm: dict[str, float]

    @property
    def names(self) -> tuple[str, ...]:
        """Return the sliders' names, those of the template's expressions."""
        return tuple(control.name for control in self.sliders.each)

    @cached_property
    def basis(self) -> Floats:
        """The modes (r, n, 3) in mm."""
        return np.asarray(self.skin.basis, np.float64)

    @classmethod
    def make(
        cls,
        face: Face,
        names: Sequence[str],
        basis: ExpressionBasis,
        listen: Callable[[str, float], None],
        options: LiveSkinOptions = LIVE_SKIN,
    ) -> LiveSkin:
        """Simulate poses of a face and reduce them; raises as :func:`make_live_preview`."""
        made = make_live_preview(
            face,
            names,
            basis,
            seed=options.seed,
            seconds=options.seconds,
            listen=listen,
            options=options.preview,
        )
        return cls(made.controls, made.skin, made.unseen.overall())

    def save(self, path: Path, face: Face, shapes: NDArray[np.floating]) -> None:
        """Write the skin as NPZ; it is of a face and a template's ``shapes``."""
        header = {
            "format": FORMAT,
            "of": basis_identity(face, shapes),
            "names": list(self.names),
            "error_mm": self.error_mm,
        }
        skin = self.skin
        arrays = {
            "directions": self.sliders.directions,
            "basis": skin.basis,
            "linear": skin.linear,
            "quadratic": skin.quadratic,
        }
        Archive(header, arrays).write(path)

    @classmethod
    def load(cls, path: Path, face: Face, shapes: NDArray[np.floating]) -> LiveSkin | None:
        """Return what :meth:`save` wrote of a face and shapes; None if it is of others.

        Raises :class:`~solver.errors.InputError`: ``live_skin.unreadable``, ``live_skin.format``.
        """
        archive = Archive.read(path, "live_skin", "a live session's skin", FORMAT)
        if archive.header.get("of") != basis_identity(face, shapes):
            return None
        arrays = archive.arrays
        names = archive.header["names"]
        controls = tuple(Control(name, "expression", name) for name in names)
        presets = dict(zip(names, np.eye(len(names)), strict=True))
        rest = face.rest_pose()
        sliders = Sliders(controls, rest, arrays["directions"], presets, face.jaw)
        skin = ReducedSkin(arrays["basis"], arrays["linear"], arrays["quadratic"])
        return cls(sliders, skin, archive.header["error_mm"])


class SkinProjection:
    """Amounts of modes (r, n, 3) that come nearest to skins, on the points of the face.

    What is off the face counts little, as where the modes were made.
    """

    def __init__(
        self,
        model: SubjectModel,
        basis: Floats,
        off_face: float = PreviewOptions.off_face,
        ridge: float = 1e-9,
    ) -> None:
        weights = np.full(basis.shape[1], off_face)
        weights[model.face] = 1.0
        self._neutral = model.skin.vertices
        weighted = (basis * weights[:, None]).reshape(len(basis), -1)
        gram = weighted @ basis.reshape(len(basis), -1).T
        gram[np.diag_indices_from(gram)] += ridge * np.trace(gram) / len(gram)
        self._rows = np.linalg.solve(gram, weighted)

    def __call__(self, skin: Floats) -> Floats:
        """Return the amounts (r,) of a skin (n, 3)."""
        return np.asarray(self._rows @ (skin - self._neutral).ravel())
