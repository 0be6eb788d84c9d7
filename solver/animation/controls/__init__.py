"""Controls learned from exact solves: activations, jaw and skin of weights of shapes.

Blending fitted shapes linearly is half a millimetre off where they meet. Here two maps are learned
of thousands of mixtures that were fitted exactly (:mod:`.pairs`), in the measure of the skin that
they move (:mod:`.metric`): a polynomial and a network (:mod:`.maps`). What lies between both is
what the face does; where they disagree it is in doubt (:mod:`.doubt`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from solver.animation.blendshapes import ShapedPose, keep_within
from solver.animation.controls.doubt import Doubt
from solver.animation.controls.maps import Network, PolynomialMap
from solver.animation.controls.metric import pose_of
from solver.animation.controls.skin import SkinModes
from solver.errors import InputError
from solver.fitting.drives import MuscleDrive
from solver.fitting.drives.stored import restore, store
from solver.fitting.face import Pose
from solver.fitting.interior_point import FeasibleSet
from solver.kinds import FILES
from solver.model import SubjectModel, identity
from solver.storage import Archive, with_prefix
from solver.surface import Floats

FILE = "controls.npz"
FORMAT = FILES[FILE].format


@dataclass(frozen=True, eq=False)
class Controls:
    """Controls of a person's rig by weights (e,) of the shapes ``names``, from 0 to 1.

    The maps give r coordinates: those of the muscles and the jaw, whose ``directions`` (a, 6 m + 5)
    are changes off the rest, those of the skin's modes, and how far an exact solve is off the
    mixture's own skin in mm. ``share`` is the polynomial's part in them, from 0 to 1. ``drive`` is
    what the muscles kept to. ``figures`` tell how they were learned, and of unseen mixtures how
    well.
    """

    names: tuple[str, ...]
    muscles: tuple[str, ...]
    drive: MuscleDrive
    polynomial: PolynomialMap
    network: Network
    share: float
    directions: NDArray[np.float32]
    skin_modes: SkinModes
    doubt: Doubt
    figures: Mapping[str, Any] = field(default_factory=dict)

    def pose_of(self, weights: Floats, limits: FeasibleSet | None = None) -> ShapedPose:
        """Return the pose of ``weights`` (e,), its muscles within ``limits`` if there are some."""
        pose = self.pose(weights)
        a, clamped = keep_within(pose.a, limits)
        return ShapedPose(a, pose.b, clamped)

    def pose(self, weights: Floats) -> Pose:
        """Return activations and the free jaw of ``weights`` (e,), cut to 0 to 1."""
        return pose_of(self.changes(weights))

    def changes(self, weights: Floats) -> Floats:
        """Return the changes (..., 6 m + 5) off the rest of ``weights`` (..., e)."""
        found = self._between(weights)[..., : len(self.directions)]
        return np.asarray(found @ self.directions, float)

    def skin(self, weights: Floats) -> NDArray[np.float32]:
        """Return the skin (..., v, 3) of ``weights`` (..., e) without simulation or contact, mm."""
        return self.skin_modes.expand(self.skin_coordinates(weights))

    def skin_coordinates(self, weights: Floats) -> NDArray[np.float32]:
        """Return the coordinates (..., r) of that skin in ``skin_modes``."""
        return self._between(weights)[..., len(self.directions) : -1]

    def doubt_mm(self, weights: Floats) -> Floats:
        """Return how far off the face of ``weights`` (..., e) may be, root mean squares in mm."""
        first, second = self._both(weights)
        ours = slice(len(self.directions))
        apart = np.asarray(np.linalg.norm(first[..., ours] - second[..., ours], axis=-1), float)
        return self.doubt.of(apart, np.asarray(self._mix(first, second)[..., -1], float))

    def _between(self, weights: Floats) -> NDArray[np.float32]:
        return self._mix(*self._both(weights))

    def _mix(self, first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
        return second + np.float32(self.share) * (first - second)

    def _both(self, weights: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        c = np.clip(weights, 0.0, 1.0).astype(np.float32)
        return self.polynomial(c), self.network(c)

    def save(self, path: Path, model: SubjectModel, S: sp.csr_array) -> None:
        """Write the controls as NPZ; they are of ``model`` with S."""
        arrays = {
            **{f"polynomial_{name}": array for name, array in self.polynomial.arrays().items()},
            **{f"network_{name}": array for name, array in self.network.arrays().items()},
            "directions": self.directions,
            "skin_rest": self.skin_modes.rest,
            "skin_modes": self.skin_modes.modes,
        }
        header = {
            "format": FORMAT,
            "of": identity(model, S),
            "names": self.names,
            "muscles": self.muscles,
            "drive": store(self.drive),
            "share": self.share,
            "doubt": asdict(self.doubt),
            "figures": self.figures,
        }
        Archive(header, arrays).write(path)

    @classmethod
    def load(cls, path: Path, model: SubjectModel, S: sp.csr_array) -> Controls:
        """Read controls that :meth:`save` wrote of ``model`` with S.

        Raises :class:`InputError`: ``controls.unreadable``, ``controls.format``, or
        ``controls.model`` if they are another model's or another S's.
        """
        archive = Archive.read(path, "controls", "a file of learned controls", FORMAT)
        header = archive.header
        data = archive.arrays
        if header.get("of") != identity(model, S):
            reason = f"{path.name} belongs to another rig"
            raise InputError("controls.model", reason, file=path.name)
        try:
            found = cls(
                tuple(header["names"]),
                tuple(header["muscles"]),
                restore(header["drive"], model, S),
                PolynomialMap.of(with_prefix(data, "polynomial_")),
                Network.of(with_prefix(data, "network_")),
                float(header["share"]),
                data["directions"],
                SkinModes(data["skin_rest"], data["skin_modes"]),
                Doubt(**header["doubt"]),
                header["figures"],
            )
            rest = np.zeros(len(found.names))
            for values, shape in (
                (found.changes(rest), (6 * model.muscle_count + 5,)),
                (found.skin(rest), model.skin.vertices.shape),
            ):
                if values.shape != shape or not np.isfinite(values).all():
                    raise ValueError("its arrays do not fit each other")
        except (LookupError, TypeError, ValueError) as error:
            reason = f"{path.name} is not a file of learned controls: {error}"
            raise InputError("controls.unreadable", reason, file=path.name) from error
        return found
