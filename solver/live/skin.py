"""The reduced skin of a live session: a template's expressions as sliders, and modes they move.

The skin is the neutral + amounts @ basis, and the first amounts are quadratic in the sliders'
values (:class:`~solver.rig.frames.skin_basis.ReducedSkin`). The others are of spare modes: what
muscles do at rest beside the expressions, for full solves to mend the skin by. It is made once for
a rig, which takes minutes, and kept as ``live_skin.npz``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from solver.fitting import prior
from solver.fitting.expression_basis import ExpressionBasis, basis_identity
from solver.fitting.face import Face
from solver.fitting.sensitivity import Sensitivity
from solver.kinds import FILES
from solver.model import SubjectModel
from solver.rig.frames.skin_basis import ReducedSkin, ReductionOptions, modes_of
from solver.rig.preview import Listener, PreviewOptions, make_live_preview, skin_weights
from solver.rig.preview.sliders import Sliders, expression_controls
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
    spare: int = 192  # modes of muscles
    block: int = 64  # of the controls whose motions are made at a time
    preview: PreviewOptions = field(
        default_factory=lambda: PreviewOptions(reduction=ReductionOptions(modes=96))
    )


LIVE_SKIN = LiveSkinOptions()


@dataclass(frozen=True, eq=False)
class LiveSkin:
    """Sliders with the skin that they move; ``error_mm`` are figures of poses not learned from."""

    sliders: Sliders
    reduced: ReducedSkin
    spare: NDArray[np.float16]  # (t, n, 3) modes that no slider moves
    error_mm: dict[str, float]

    @property
    def names(self) -> tuple[str, ...]:
        """Return the sliders' names, those of the template's expressions."""
        return tuple(control.name for control in self.sliders.each)

    @cached_property
    def basis(self) -> Floats:
        """All modes (r, n, 3) in mm, the spare ones last."""
        return np.concatenate([self.reduced.basis, self.spare]).astype(np.float64)

    def amounts(self, values: Floats) -> Floats:
        """Return the amounts (r,) of all modes for slider values (s,), 0 of the spare ones."""
        return np.append(self.reduced.amounts(values), np.zeros(len(self.spare)))

    @classmethod
    def make(
        cls,
        face: Face,
        names: Sequence[str],
        basis: ExpressionBasis,
        listen: Listener,
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
        spare = muscle_modes(face, basis, made.skin.basis.astype(np.float64), options)
        return cls(made.controls, made.skin, spare, made.unseen.overall())

    def save(self, path: Path, face: Face, shapes: NDArray[np.floating]) -> None:
        """Write the skin as NPZ; it is of a face and a template's ``shapes``."""
        header = {
            "format": FORMAT,
            "of": basis_identity(face, shapes),
            "names": list(self.names),
            "error_mm": self.error_mm,
        }
        reduced = self.reduced
        arrays = {
            "directions": self.sliders.directions,
            "basis": reduced.basis,
            "spare": self.spare,
            "linear": reduced.linear,
            "quadratic": reduced.quadratic,
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
        sliders = expression_controls(face, archive.header["names"], arrays["directions"])
        skin = ReducedSkin(arrays["basis"], arrays["linear"], arrays["quadratic"])
        return cls(sliders, skin, arrays["spare"], archive.header["error_mm"])


def muscle_modes(
    face: Face, basis: ExpressionBasis, modes: Floats, options: LiveSkinOptions
) -> NDArray[np.float16]:
    """Return modes (t, n, 3) of what muscles and jaw do at rest, less what ``modes`` (r, n, 3) do.

    It is the flesh's linear response, each motion as far as it is probable. All controls count: the
    expressions' prior leaves those that no expression has alike, and which of them a full solve
    will use is the markers' to say. Of the most probable 256 directions alone 128 modes left
    0.11 mm of fits of 79 markers, of all 0.08 mm.
    """
    spread = prior.from_basis(face, basis).covariance
    root = np.asarray(np.linalg.cholesky(spread), np.float64)
    sensitivity = Sensitivity(face, face.rest)
    rows = SkinProjection(face.model, modes).rows
    left = np.empty((root.shape[1], *face.model.skin.vertices.shape), np.float32)
    for first in range(0, len(left), options.block):
        some = slice(first, first + options.block)
        flesh = sensitivity.motions_along(root[:, some]).reshape(len(face.model.rest), 3, -1)
        by_jaw = root[face.layout.joint_places, some]
        motions = np.moveaxis(face.skin_rates(flesh, face.rest.pose.b, by_jaw), 2, 0)
        known = motions.reshape(len(motions), -1) @ rows.T
        left[some] = motions - np.tensordot(known, modes, 1)
    weights = skin_weights(face.model, options.preview)
    found = modes_of(left, weights, ReductionOptions(modes=options.spare))
    return np.asarray(found / np.abs(found).max(axis=(1, 2), keepdims=True), np.float16)


class SkinProjection:
    """Amounts of modes (r, n, 3) that come nearest to skins, on the points of the face.

    What is off the face counts little, as where the modes were made. ``rows`` (r, 3 n) are the
    amounts' derivative by the skin.
    """

    def __init__(self, model: SubjectModel, basis: Floats, ridge: float = 1e-9) -> None:
        self._neutral = model.skin.vertices
        weighted = (basis * skin_weights(model)[:, None]).reshape(len(basis), -1)
        gram = weighted @ basis.reshape(len(basis), -1).T
        gram[np.diag_indices_from(gram)] += ridge * np.trace(gram) / len(gram)
        self.rows = np.linalg.solve(gram, weighted)

    def __call__(self, skin: Floats) -> Floats:
        """Return the amounts (r,) of a skin (n, 3)."""
        return np.asarray(self.rows @ (skin - self._neutral).ravel())
