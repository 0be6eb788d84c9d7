"""A subject's blendshapes: activations and jaw of every expression of its template, solved once.

The target of a shape is the subject's neutral with the template's displacement added, and the fit
is that of an expression of a known S. Which of ARKit's weights drives a shape, its name says.

A corrective shape (``mouthClose`` brings the lips of an open jaw together) cannot be had alone:
its lips would go through each other. It is solved together with the one that it corrects, both half
way, and is what the two have beyond that one. Lips that met over a jaw as wide open as it goes
would be stretched further than flesh is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp

from solver.anatomy.template import CORRECTED, ShapeBasis
from solver.errors import InputError, SolveError
from solver.fitting import activation
from solver.fitting.activation import UNSEEN_STOP, DescentOptions, objective, unseen_regulariser
from solver.fitting.contact import terms
from solver.fitting.drives import MuscleDrive
from solver.fitting.drives.six_numbers import LEAST_STRETCH, SixNumbers
from solver.fitting.drives.stored import restore, store
from solver.fitting.expression_basis import begin_at
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.interior_point import Bounds, FeasibleSet
from solver.fitting.objective import Prior, Target, Term
from solver.fitting.steps import FeasibleStepOptions
from solver.fitting.stretches import COLUMN, ROW, matrices
from solver.kinds import FILES
from solver.mechanics.flesh import IDENTITY
from solver.model import SubjectModel, identity
from solver.scans.live_link import ARKIT_NAMES
from solver.storage import Archive, Arrays
from solver.surface import Floats
from solver.templates.ict_facekit import arkit_source


@dataclass(frozen=True)
class Blend:
    """Expressions ``names``: ``activations`` (e, m, 6) and ``jaw`` (e, 5), blended linearly.

        a(w) = a_I + sum_e w_e (a_e - a_I),    b(w) = sum_e w_e b_e

    as published for blendshape-driven animation (Phace, SIGGRAPH 2017), a_I being those of rest.
    """

    names: tuple[str, ...]
    activations: Floats
    jaw: Floats

    @classmethod
    def of(cls, poses: Mapping[str, Pose], muscles: int) -> Blend:
        """Return the blend of named poses of a face with so many ``muscles``."""
        a = np.array([pose.a for pose in poses.values()]).reshape(-1, muscles, 6)
        b = np.array([pose.b for pose in poses.values()]).reshape(-1, 5)
        return cls(tuple(poses), a, b)

    def pose(self, weights: Floats) -> Pose:
        """Return the blend by ``weights`` (e,), cut to 0 to 1; it may still fold muscles."""
        share = np.clip(weights, 0.0, 1.0)
        a = IDENTITY + np.tensordot(share, self.activations - IDENTITY, 1)
        return Pose(np.asarray(a), np.asarray(share @ self.jaw))


@dataclass(frozen=True)
class ShapedPose:
    """A face posed by weights of shapes: activations ``a`` (m, 6) and ``jaw`` (5,).

    ``clamped`` counts the muscles that were kept within their limits, or from folding;
    ``target`` (p, 3) is where tracks pull the flesh, if tracks drive it.
    """

    a: Floats
    jaw: Floats
    clamped: int = 0
    target: Floats | None = None


class DrivenShapes(Protocol):
    """Shapes that a recording drives by their names."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the shapes' names."""

    def pose_of(self, weights: Floats, limits: FeasibleSet | None = None) -> ShapedPose:
        """Return the pose of ``weights`` (e,) from 0 to 1, within ``limits`` if there are some."""


def unfold(a: Floats) -> tuple[Floats, int]:
    """Return activations (m, 6) with every eigenvalue at least what fits keep to.

    Where expressions add up, a muscle may come out so short that its S(a) folds its flesh. The
    second value counts these.
    """
    values, axes = np.linalg.eigh(matrices(a))
    folded = np.flatnonzero(values[:, 0] < LEAST_STRETCH)
    kept = np.maximum(values[folded], LEAST_STRETCH)
    whole = (axes[folded] * kept[:, None]) @ axes[folded].transpose(0, 2, 1)
    result = a.copy()
    result[folded] = whole[:, ROW, COLUMN]
    return result, len(folded)


def keep_within(a: Floats, limits: FeasibleSet | None) -> tuple[Floats, int]:
    """Return activations (m, 6) within the ``limits`` of a face's muscles, if it has any.

    Expressions that add up leave them, though each is within; of muscles without limits those that
    fold are unfolded. The second value counts the muscles that were brought back.
    """
    if limits is None:
        return unfold(a)
    beyond = np.any(limits.margins(a) <= 0.0, axis=1)
    if not beyond.any():
        return a, 0
    kept = limits.nearest(a, Bounds.clipped)
    return np.where(beyond[:, None], kept, a), int(beyond.sum())


FORMAT = FILES["blendshapes.npz"].format
STORED = ("activations", "jaw", "mean_mm", "settled")  # its arrays
CORRECTED_AT = 0.5  # weight of a corrective and of what it corrects, where they are solved
# mm; a shape that moves no point of the face further is nothing for muscles: a tongue, a pupil
LEAST_MOTION_MM = 0.05
NOTHING_KNOWN: Mapping[str, Floats] = MappingProxyType({})
SHORT = DescentOptions(steps=FeasibleStepOptions.quick())  # within limits: there are fifty shapes


@dataclass(frozen=True)
class Solved:
    """One shape: its ``pose``, and the mean distance of the face to its target, mm.

    ``settled`` is false where no equilibrium was found: the pose is that of rest then. A
    corrective's pose is a difference, added to rest, and its distance that at ``CORRECTED_AT``.
    """

    pose: Pose
    mean_mm: float
    settled: bool = True


@dataclass(frozen=True)
class Blendshapes:
    """The shapes by name, as the template calls them.

    ``muscles`` are the names of those that make them, within the limits of ``drive``.
    ``outdated`` are correctives that a file had and that are left out, as an earlier release solved
    them at another weight.
    """

    muscles: tuple[str, ...]
    shapes: Mapping[str, Solved]
    drive: MuscleDrive = field(default_factory=SixNumbers)
    outdated: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Return the shapes' names."""
        return tuple(self.shapes)

    @cached_property
    def blend(self) -> Blend:
        """The shapes as what poses are blended of."""
        poses = {name: shape.pose for name, shape in self.shapes.items()}
        return Blend.of(poses, len(self.muscles))

    def pose_of(self, weights: Floats, limits: FeasibleSet | None = None) -> ShapedPose:
        """Return the blend by ``weights`` (e,), its muscles within ``limits`` if there are some."""
        pose = self.blend.pose(weights)
        a, clamped = keep_within(pose.a, limits)
        return ShapedPose(a, pose.b, clamped)

    def save(self, path: Path, model: SubjectModel, S: sp.csr_array) -> None:
        """Write the shapes as NPZ, replacing the file whole; they are of ``model`` with S."""
        blend = self.blend
        shapes = self.shapes.values()
        arrays: Arrays = {
            "names": np.array(blend.names, np.str_),
            "activations": blend.activations,
            "jaw": blend.jaw,
            "mean_mm": np.array([shape.mean_mm for shape in shapes]),
            "settled": np.array([shape.settled for shape in shapes], bool),
        }
        header = {
            "format": FORMAT,
            "of": identity(model, S),
            "muscles": self.muscles,
            "drive": store(self.drive),
            "names": blend.names,
            "corrected_at": CORRECTED_AT,
        }
        Archive(header, arrays).write(path)

    @classmethod
    def load(cls, path: Path, model: SubjectModel, S: sp.csr_array) -> Blendshapes:
        """Read shapes that :meth:`save` wrote of ``model`` with S.

        Raises :class:`InputError`: ``blendshapes.unreadable``, ``blendshapes.format``, or
        ``blendshapes.model`` if they are another model's or another S's.
        """
        archive = Archive.read(path, "blendshapes", "a set of blendshapes", FORMAT)
        header = archive.header
        data = archive.arrays
        try:
            muscles = tuple(header["muscles"])
            shapes = {}
            # those before had no limits
            drive = restore(header.get("drive", store(SixNumbers())), model, S)
            for row, name in enumerate(header["names"]):
                a, b, mean, settled = (data[key][row] for key in STORED)
                shapes[name] = Solved(Pose(a, b), float(mean), bool(settled))
        except (LookupError, TypeError, ValueError) as error:
            reason = f"{path.name} is not a set of blendshapes: {error}"
            raise InputError("blendshapes.unreadable", reason, file=path.name) from error
        if not _is_of(header, model, S):
            reason = f"{path.name} belongs to another rig"
            raise InputError("blendshapes.model", reason, file=path.name)
        outdated: tuple[str, ...] = ()
        if header.get("corrected_at") != CORRECTED_AT:
            outdated = tuple(name for name in shapes if name in CORRECTED)
        kept = {name: shape for name, shape in shapes.items() if name not in outdated}
        return cls(muscles, kept, drive, outdated)


def _is_of(header: Mapping[str, Any], model: SubjectModel, S: sp.csr_array) -> bool:
    """Tell whether a file is of a model with S; those of 0.1 have one hash of both."""
    if "of" in header:
        return bool(header["of"] == identity(model, S))
    digest = hashlib.sha256(model.sha256.encode())
    for array, kind in ((S.data, "<f8"), (S.indices, "<i8"), (S.indptr, "<i8")):
        digest.update(np.ascontiguousarray(array, kind).tobytes())
    return bool(header.get("rig") == digest.hexdigest())


def driven_motions(model: SubjectModel, basis: ShapeBasis | None) -> dict[str, Floats]:
    """Return name -> the motions (k, 3) of the face's points of every shape that ARKit drives, mm.

    ``basis`` are the template's shapes. Raises :class:`InputError`: ``blendshapes.none`` if ARKit
    drives no expression of the template, ``blendshapes.topology`` if they are of another skin.
    """
    names, shapes = (basis.expression_names, basis.expressions) if basis else ((), ())
    expected = len(model.skin.vertices)
    if basis and basis.expressions.shape[1] != expected:
        found = basis.expressions.shape[1]
        reason = f"the template's expressions have {found} vertices, the subject has {expected}"
        raise InputError("blendshapes.topology", reason, expected=expected, found=found)
    motions = {}
    for name, shape in zip(names, shapes, strict=True):
        motion = shape[model.face].astype(np.float64)
        moves = np.linalg.norm(motion, axis=1).max() > LEAST_MOTION_MM
        if moves and arkit_source(name) in ARKIT_NAMES:
            motions[name] = motion
    if not motions:
        reason = "has no expressions that a recording could drive"
        name = model.template.get("name", "")
        raise InputError("blendshapes.none", f"the template {name} {reason}")
    return motions


def expression_targets(model: SubjectModel, basis: ShapeBasis | None) -> dict[str, Floats]:
    """Return name -> the places (k, 3) of the face's points in every shape that ARKit drives.

    A corrective comes after the shape it corrects, and has its motion too. Raises as
    :func:`driven_motions`.
    """
    motions = driven_motions(model, basis)
    neutral = model.skin.vertices[model.face]
    targets = {name: neutral + motion for name, motion in motions.items() if name not in CORRECTED}
    for name in motions.keys() - targets.keys():
        targets[name] = neutral + motions[name] + motions.get(CORRECTED[name], 0.0)
    return targets


def solved_at(name: str) -> float:
    """Return the weight at which a shape is solved, and what it corrects with it."""
    return CORRECTED_AT if name in CORRECTED else 1.0


def solve_blendshapes(
    face: Face,
    targets: Mapping[str, Floats],
    done: Mapping[str, Solved],
    listen: Callable[[str, Solved], None],
    known: Mapping[str, Floats] = NOTHING_KNOWN,
) -> Blendshapes:
    """Fit activations and jaw to ``targets``, name -> the face's points (k, 3) in mm.

    Muscles stay within the face's limits, and the jaw's numbers are those of a free one. Shapes
    that are ``done`` are taken as they are; ``listen`` hears of every other as it is solved. A fit
    begins with the change (k,) of the controls that is ``known`` to make about its shape, of an
    :class:`~solver.fitting.expression_basis.ExpressionBasis`, else at rest. A shape that does not
    come to rest stays at rest.
    """
    neutral = face.model.skin.vertices[face.model.face]
    missing = {
        name: Target.from_points(neutral + solved_at(name) * (points - neutral))
        for name, points in targets.items()
        if name not in done
    }
    found = dict(done)
    if missing:
        data = terms(face, missing)
        for name, target in missing.items():
            regulariser = unseen_regulariser(face, target)
            try:
                start = _start(face, name, data[name], regulariser, known)
                fit = activation.fit(
                    face, data[name], regulariser, start, UNSEEN_STOP, descent=SHORT
                )
                state = fit.state
                settled = True
            except (SolveError, np.linalg.LinAlgError):
                state = face.rest
                settled = False
            off = target.distances(face.face_points(state.x))
            pose = Pose(state.pose.a, face.five_jaw_numbers(state.pose.b))
            change = (pose.a - IDENTITY) / solved_at(name)
            jaw = pose.b / solved_at(name)
            corrected = found.get(CORRECTED.get(name, ""))
            if corrected is not None:
                change = change - (corrected.pose.a - IDENTITY)
                jaw = jaw - corrected.pose.b
            if name in CORRECTED:
                pose = Pose(IDENTITY + change, jaw)
            found[name] = Solved(pose, float(off.mean()), settled)
            listen(name, found[name])
    shapes = {name: found[name] for name in targets}
    return Blendshapes(face.model.muscle_names, shapes, face.drive)


def _start(
    face: Face, name: str, data: Term, regulariser: Prior, known: Mapping[str, Floats]
) -> PosedFace | None:
    """Return where the fit of a shape begins; None: at rest. A corrective has the corrected's."""
    if name not in known:
        return None
    change = solved_at(name) * (known[name] + known.get(CORRECTED.get(name, ""), 0.0))
    return begin_at(face, change, lambda state: objective(data, regulariser, state))
