"""A template's expressions on one face: the changes of its controls that make each shape.

Small shapes are the flesh's linear response at rest; large ones are fitted, at parts of their way.
A basis is solved once for a rig, within its limits, and kept: markers have their prior of it, live
sliders are made of it, whole fits of blendshapes and of proposed scans begin with it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from solver.errors import InputError, SolveError
from solver.fitting.activation import ActivationOptions, fit, rest_curvature, unseen_regulariser
from solver.fitting.drives.stored import store
from solver.fitting.face import Face, PosedFace
from solver.fitting.objective import PartPrior, Prior, PriorSum, SkinDistance, Target
from solver.fitting.sensitivity import Sensitivity
from solver.kinds import FILES
from solver.mechanics.jaw_tracks import nearest_jaw
from solver.model import identity
from solver.storage import Archive
from solver.surface import Floats, Ints

FILE = "expression_basis.npz"
FORMAT = FILES[FILE].format
OTHER = "basis.other"
# by the parts of a basis's identity
OTHER_PARTS = {
    "model": "another person, or of another build of this one",
    "weights": "a rig with another muscle geometry",
    "drive": "muscles with other controls or limits",
    "joints": "another kind of jaw",
    "shapes": "other expressions than the template's",
}


@dataclass(frozen=True)
class BasisFitOptions:
    """Choice of the shapes that are fitted, and the effort of their fits."""

    large_mm: float = 1.0  # mean motion of the face from which a shape is fitted ...
    fitted_parts: tuple[float, ...] = (0.5,)  # ... at these parts of it, ...
    fitted_from: float = 0.7  # ... from so much of what is linear
    # the same for a jaw on tracks, which is held where the shape has the teeth: muscles that make
    # up for flesh far off them do so otherwise half way
    parts_on_tracks: tuple[float, ...] = (0.5, 1.0)
    held: float = 100.0  # weight of that, per squared unit of the jaw
    effort: ActivationOptions = field(default_factory=lambda: ActivationOptions(8, tolerance=3e-3))


LINEAR = BasisFitOptions(large_mm=np.inf)  # nothing is fitted: a tenth of a second


@dataclass(frozen=True, eq=False)
class ExpressionBasis:
    """Expressions of a face.

    ``shapes`` (e, v, 3) are motions of the whole skin, mm, and ``changes`` for each the changes
    (j, k) of the controls off the rest that make it, each scaled to the whole shape: of fits to
    parts of it the greatest part's comes last.
    """

    shapes: NDArray[np.floating]
    changes: tuple[Floats, ...]

    @property
    def whole(self) -> Floats:
        """Return the changes (e, k) that make the whole shapes best."""
        return np.array([each[-1] for each in self.changes])

    @classmethod
    def solve(
        cls,
        face: Face,
        shapes: NDArray[np.floating],
        options: BasisFitOptions = BasisFitOptions(),
        listen: Callable[[float], None] = lambda _done: None,
    ) -> ExpressionBasis:
        """Return the changes that make ``shapes`` (e, v, 3) on a face, within its limits.

        A shape's linear change is the regularised least squares of the face's points; and, of a jaw
        on tracks, of the lower teeth. A free jaw follows the skin alone: it has the freedom to make
        up for flesh that moves otherwise than the shapes. A fit takes a second; ``listen`` gets the
        part that is done. Shapes that cannot be fitted keep their linear change.
        """
        linear = _linear_changes(face, shapes)
        changes = [each[None] for each in linear]
        large = np.flatnonzero(_mean_motion(face, shapes) > options.large_mm)
        parts = options.parts_on_tracks if follows_teeth(face) else options.fitted_parts
        for count, number in enumerate(large.tolist()):
            fitted = []
            for part in parts:
                with suppress(SolveError, np.linalg.LinAlgError):
                    fitted.append(
                        _fitted_change(face, shapes[number], linear[number], part, options)
                    )
            if fitted:
                changes[number] = np.array(fitted)
            listen((count + 1) / len(large))
        return cls(shapes, tuple(changes))

    def save(self, path: Path, face: Face) -> None:
        """Write the changes as NPZ; they are of ``face``."""
        counts = np.array([len(each) for each in self.changes])
        arrays = {"counts": counts, "changes": np.vstack(self.changes)}
        Archive({"format": FORMAT, "of": basis_identity(face, self.shapes)}, arrays).write(path)

    @classmethod
    def load(cls, path: Path, face: Face, shapes: NDArray[np.floating]) -> ExpressionBasis:
        """Return what :meth:`save` wrote of a face and shapes.

        Raises :class:`InputError`: ``basis.unreadable``, ``basis.format``, and :data:`OTHER` if it
        is of another face or of other shapes.
        """
        archive = Archive.read(path, "basis", "a basis of expressions", FORMAT)
        of = archive.header.get("of", {})
        for part, wanted in basis_identity(face, shapes).items():
            if of.get(part) != wanted:
                message = f"{path.name} is of {OTHER_PARTS[part]}"
                raise InputError(OTHER, message, file=path.name)
        counts, changes = (archive.arrays.get(name) for name in ("counts", "changes"))
        if (
            counts is None
            or changes is None
            or counts.shape != (len(shapes),)
            or changes.shape != (counts.sum(), face.layout.size)
            or not np.isfinite(changes).all()
        ):
            message = f"{path.name} has not the changes of {len(shapes)} expressions"
            raise InputError("basis.unreadable", message, file=path.name)
        return cls(shapes, tuple(np.split(changes, np.cumsum(counts)[:-1])))


def begin_at(face: Face, change: Floats, value: Callable[[PosedFace], float]) -> PosedFace | None:
    """Return the state at which a fit begins that a basis's ``change`` (k,) comes near to.

    ``value`` is what is fitted, of a state. A whole change may bring the lips through each other,
    where a fit gets stuck: then it is half of the change, if that is better. None where the flesh
    comes to rest at neither.
    """

    def at(part: float) -> PosedFace | None:
        with suppress(SolveError):
            return face.continuation(face.rest, face.rest_pose().add(part * change))
        return None

    whole = at(1.0)
    # half way the squared distance alone is a quarter of that at rest
    if whole is not None and value(whole) <= 0.25 * value(face.rest):
        return whole
    found = [each for each in (whole, at(0.5)) if each is not None]
    return min(found, key=value, default=None)


def face_identity(face: Face) -> dict[str, Any]:
    """Return what controls are of: the person with S, its drive and joints."""
    return {
        **identity(face.model, face.S),
        "drive": store(face.drive),
        "joints": [joint.name for joint in face.layout.joints],
    }


def basis_identity(face: Face, shapes: NDArray[np.floating]) -> dict[str, Any]:
    """Return what a basis is of: a face, and the shapes."""
    return {
        **face_identity(face),
        "shapes": hashlib.sha256(np.ascontiguousarray(shapes, "<f4").tobytes()).hexdigest(),
    }


def _mean_motion(face: Face, shapes: NDArray[np.floating]) -> Floats:
    return np.asarray(np.linalg.norm(shapes[:, face.model.face], axis=2).mean(axis=1))


def follows_teeth(face: Face) -> bool:
    """Tell whether shapes' teeth say where the jaw is, which their skin does of a free one."""
    return len(face.model.lower_teeth) > 0 and not face.joint.is_free


def jaw_of_teeth(
    face: Face, teeth: Floats, goal: Floats, start: Floats, inner: Floats | None = None
) -> tuple[Ints, Floats]:
    """Return where the jaw stands among the controls, and what carries ``teeth`` to a ``goal``.

    The arguments are those of :func:`nearest_jaw`; the numbers are within the jaw's bounds.
    """
    places = face.layout.places(face.joint.block.name)
    bounds = face.joint.block.lower, face.joint.block.upper
    return places, nearest_jaw(face.jaw, teeth, goal, start, inner=inner, bounds=bounds)


def _linear_changes(face: Face, shapes: NDArray[np.floating]) -> Floats:
    """Return the changes (e, k) of the controls that make the shapes, to first order at rest."""
    jacobian = Sensitivity(face, face.rest).by_pose()
    hessian = rest_curvature(face)
    moved = np.asarray(shapes[:, face.model.face], np.float64) * (2.0 / len(face.model.face))
    pulls = np.array([jacobian.adjoint(face.face_embedding.T @ shape) for shape in moved])
    if follows_teeth(face):
        teeth = face.model.lower_teeth
        rows = _teeth_by_controls(face)
        part = 2.0 / len(teeth)
        hessian = hessian + part * (rows.T @ rows)  # not in place: it is kept for the face
        pulls += part * (shapes[:, teeth].reshape(len(shapes), -1) @ rows)
    rest = face.model.skin.vertices[face.model.face]
    pose = face.rest.pose
    priors = (
        unseen_regulariser(face, Target.from_points(rest + shape[face.model.face]))
        for shape in shapes
    )
    changes = [
        scipy.linalg.solve(hessian + prior.gauss_newton(pose), pull, assume_a="pos")
        for prior, pull in zip(priors, pulls, strict=True)
    ]
    return np.array(changes)


def _fitted_change(
    face: Face, shape: NDArray[np.floating], change: Floats, part: float, options: BasisFitOptions
) -> Floats:
    """Return the change (k,) of a fit to ``part`` of a shape, which ``change`` makes about."""
    points = face.model.face
    rest = face.model.skin.vertices
    goal = rest + part * np.asarray(shape, np.float64)
    near = face.rest_pose().add(options.fitted_from * part * change)
    target = Target.from_points(goal[points])
    regulariser: Prior = unseen_regulariser(face, target)
    if follows_teeth(face):
        teeth = face.model.lower_teeth
        jaw = face.joint.block
        places, b = jaw_of_teeth(face, rest[teeth], goal[teeth], near.b)
        near = replace(near, b=b)
        weights = np.diag(options.held * np.broadcast_to(jaw.units, b.shape) ** 2)
        regulariser = PriorSum((regulariser, PartPrior(face.layout.size, places, b, weights)))
    start = face.continuation(face.rest, near)
    effort = options.effort
    found = fit(face, SkinDistance(face, target), regulariser, start, effort)
    return np.asarray((found.state.pose.vector() - face.layout.rest) / part)


def _teeth_by_controls(face: Face) -> Floats:
    """Return the derivative (3 n, k) of the lower teeth at rest by the controls."""
    layout = face.layout
    teeth = face.model.lower_teeth
    rows = np.zeros((3 * len(teeth), layout.size))
    by_jaw = face.jaw.jacobian(face.model.skin.vertices[teeth], face.rest_pose().b)
    rows[:, layout.places(face.joint.block.name)] = by_jaw.reshape(len(rows), -1)
    return rows
