"""Fibre muscles of a face, calibrated to its scans: strengths, fractions and directions.

    f = sum_k [ data_k(x_k) + regulariser(a_k, b_k) ] + 1/2 |L (g - g_0)|^2

over all poses, activations within [0, 1], and the values g: fractions s_ij, every tet's on the
simplex with what is passive, logarithms of the strengths sigma_j, and a rotation vector w_i of the
fibres of each tet with muscle. L weighs each kind of change, and differences of the rotations of
tets that share a face. The steps are those of :mod:`solver.fitting.joint`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from scipy.spatial.transform import Rotation
from typing_extensions import override

from solver.errors import InputError
from solver.fitting import activation, fallback, joint
from solver.fitting.activation import ActivationOptions
from solver.fitting.controls import Block, Layout
from solver.fitting.drives.fibre_muscles import FibreDrive
from solver.fitting.face import Face, PosedFace
from solver.fitting.fallback import FallbackFit
from solver.fitting.joint import GeometryProblem, Iterate, Listener, Shape
from solver.fitting.objective import Regulariser, Term
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.strips import StripOptions, neighbours, split_broad, strip_names
from solver.kinds import FILES
from solver.mechanics.fibre_muscle import FibreMuscles, FibreTerm
from solver.mechanics.response import SparseControls
from solver.model import SubjectModel
from solver.storage import Archive
from solver.surface import Floats, Ints, skew

# 90 kPa in flesh of 3 kPa: published activations move the skin as far as faces do
STRENGTH = 30.0
FORMAT = FILES["fibre_muscles.npz"].format


def fibre_muscles(
    face: Face, strength: float = STRENGTH, strips: StripOptions | None = None
) -> FibreMuscles:
    """Return the muscles of a face's model by its S, of so many times the flesh's mu.

    With ``strips`` the broad ones are split. Raises :class:`~solver.errors.InputError`
    (``model.fibres``) for a model without fibres.
    """
    strengths = np.full(face.model.muscle_count, face.flesh.material.mu * strength)
    whole = FibreMuscles.of(face.model, face.S, strengths)
    return split_broad(face.model.rest, face.model.tets, whole, strips) if strips else whole


def with_fibres(face: Face, muscles: FibreMuscles) -> Face:
    """Return a face driven by the activations (m,) of fibre muscles, in [0, 1]."""
    return face.driven_by(FibreDrive(muscles))


@dataclass(frozen=True)
class CalibrationOptions:
    """Rounds, weights of the poses, and stiffness of what is calibrated (mm^2 by its square)."""

    rounds: int = 16
    retries: int = 3  # of a round whose step was refused, each shorter
    strips: StripOptions | None = field(default_factory=StripOptions)  # None: muscles are whole
    first: ActivationOptions = field(default_factory=lambda: ActivationOptions(6, tolerance=1e-2))
    last: ActivationOptions = field(default_factory=lambda: ActivationOptions(20, tolerance=1e-3))
    w_a: float = 1e-3
    w_b: float = 1e-6
    strength: float = 1e-3  # of the logarithm of a strength
    fraction: float = 1e-5
    direction: float = 1e-5  # of a radian
    smooth: float = 1e-3  # of a radian between neighbours
    tolerance: float = 3e-3  # gain of a round, relative to f, below which two in turn end the fit


class FibreShape(Shape):
    """The values g of fibre muscles.

    ``layout`` has the blocks ``fractions`` (nnz) of the pattern of S, ``strengths`` (m) and
    ``directions`` (t, 3) of the tets with muscle.
    """

    def __init__(
        self, plain: Face, strength: float = STRENGTH, strips: StripOptions | None = None
    ) -> None:
        self._plain = plain
        self._begin = fibre_muscles(plain, strength, strips)
        S = plain.S
        fibres = np.asarray(plain.model.fibres)
        # the entries that FibreMuscles has, in its order
        self._entries = np.flatnonzero((S.indices > 0) & fibres.any(axis=1))
        self.tets, self._of_entry = np.unique(self._begin.tets, return_inverse=True)
        turns = np.zeros((len(self.tets), 3))
        logarithms = np.zeros(len(self._begin.strengths))
        self.layout = Layout(
            (Block("fractions", S.data), Block("strengths", logarithms), Block("directions", turns))
        )

    @override
    @property
    def indptr(self) -> Ints:
        return np.asarray(self._plain.S.indptr)

    def muscles(self, values: Floats) -> FibreMuscles:
        """Return the muscles of values (k,)."""
        fractions, logarithms, turns = self.layout.split(values)
        begin = self._begin
        rotation = Rotation.from_rotvec(turns[self._of_entry])
        return replace(
            begin,
            fractions=fractions[self._entries],
            strengths=begin.strengths * np.exp(logarithms),
            fibres=rotation.apply(begin.fibres),
        )

    @override
    def face(self, values: Floats) -> Face:
        return with_fibres(self._plain, self.muscles(values))

    @override
    def rates(self, sensitivity: Sensitivity, values: Floats) -> SparseControls:
        forces = sensitivity.forces
        flesh = self._plain.flesh
        muscles = self.muscles(values)
        term = FibreTerm(flesh, muscles)
        at = (forces.x, forces.controls)
        whole = len(self._entries), self.indptr[-1]
        ones = np.ones(len(self._entries)), (np.arange(whole[0]), self._entries)
        by_fraction = term.forces_by_fraction(*at) @ sp.csr_array(ones, shape=whole)
        by_strength = term.forces_by_strength(*at) @ sp.diags_array(muscles.strengths)
        by_turn = term.forces_by_rotation(*at) @ _turn_rates(self.layout.part("directions", values))
        columns = sp.hstack([by_fraction, by_strength, by_turn], format="csr")
        held = sp.csr_array((forces.x.size, self.layout.size))
        return SparseControls(sp.csc_array(columns[flesh.free_coordinates]), held)

    def stiffness(self, options: CalibrationOptions) -> sp.csr_array:
        """Return L (r, k)."""
        weights = [options.fraction, options.strength, options.direction]
        pairs = zip(weights, self.layout.blocks, strict=True)
        each = np.concatenate([np.full(block.rest.size, weight) for weight, block in pairs])
        one, other = neighbours(self._plain.flesh.tets[self.tets])
        places = self.layout.places("directions")
        rows = np.arange(3 * len(one))
        columns = places[one].ravel(), places[other].ravel()
        unlike = sum(
            sp.csr_array((sign * np.ones(len(rows)), (rows, column)), (len(rows), len(each)))
            for sign, column in zip((1.0, -1.0), columns, strict=True)
        )
        parts = [sp.diags_array(np.sqrt(each)), np.sqrt(options.smooth) * unlike]
        return sp.csr_array(sp.vstack(parts, format="csr"))


@dataclass(frozen=True)
class Calibration:
    """Calibrated muscles, the face they drive, and every expression as it was settled."""

    muscles: FibreMuscles
    face: Face
    endings: dict[str, FallbackFit]


def calibrate(
    plain: Face,
    data: Mapping[str, Term],
    options: CalibrationOptions = CalibrationOptions(),
    listen: Listener | None = None,
    *,
    ends: Mapping[str, Term] | None = None,
) -> Calibration:
    """Calibrate the fibre muscles of a face, whose S are the fractions to begin with, to all data.

    ``ends`` take the place of ``data`` in the last fit of the poses: the distance with contact.
    Raises :class:`~solver.errors.InputError` (``model.fibres``) for a model without fibres.
    """
    shape = FibreShape(plain, strips=options.strips)
    values = shape.layout.rest
    face = shape.face(values)
    priors = regulariser(face, options)
    states = {
        name: activation.descend(face, term, priors, face.rest, options.first).state
        for name, term in data.items()
    }
    stiffness = shape.stiffness(options)
    alike = dict.fromkeys(data, priors)
    problem = GeometryProblem(face, data, alike, 0.0, values, stiffness, shape)
    rules = joint.RoundOptions(options.retries, options.tolerance)
    now, _ = joint.minimise_rounds(
        lambda _number: problem, Iterate(values, states), range(options.rounds), rules, listen
    )
    face = shape.face(now.values)
    endings = fit_all(face, ends or data, options, now.states)
    return Calibration(shape.muscles(now.values), face, endings)


def fit_all(
    face: Face,
    data: Mapping[str, Term],
    options: CalibrationOptions = CalibrationOptions(),
    start: Mapping[str, PosedFace] | None = None,
) -> dict[str, FallbackFit]:
    """Fit activations of fibres and the jaw to all data."""
    known = start or {}
    return {
        name: fallback.fit(
            face, term, regulariser(face, options), options.last, start=known.get(name)
        )
        for name, term in data.items()
    }


def regulariser(face: Face, options: CalibrationOptions = CalibrationOptions()) -> Regulariser:
    """Return the priors of the poses of a face with fibre muscles."""
    return Regulariser(options.w_a, 0.0, options.w_b, face.rest_pose())


def save_muscles(path: Path, face: Face, muscles: FibreMuscles) -> None:
    """Write ``fibre_muscles.npz``: strengths over the flesh's mu."""
    model = face.model
    header = {
        "format": FORMAT,
        "model_sha256": model.sha256,
        "muscle_names": strip_names(model.muscle_names, muscles),
    }
    arrays = {each.name: getattr(muscles, each.name) for each in fields(muscles)}
    arrays["strengths"] = muscles.strengths / face.flesh.material.mu
    Archive(header, arrays).write(path)


def load_muscles(path: Path, face: Face) -> FibreMuscles:
    """Read what :func:`save_muscles` wrote, for a face of the same model.

    Raises as :func:`read_muscles`.
    """
    return read_muscles(path, face.model).scale(face.flesh.material.mu)


def read_muscles(path: Path, model: SubjectModel) -> FibreMuscles:
    """Read what :func:`save_muscles` wrote of this model: strengths over the flesh's mu.

    Raises :class:`InputError` (``fibres.unreadable``, ``fibres.format``, ``fibres.model``).
    """
    archive = Archive.read(path, "fibres", "a file of fibre muscles", FORMAT)
    try:
        muscles = FibreMuscles(
            **{each.name: archive.arrays[each.name] for each in fields(FibreMuscles)}
        )
        of_model = archive.header["model_sha256"] == model.sha256
    except (KeyError, TypeError) as error:
        message = f"{path.name} is not a file of fibre muscles: {error}"
        raise InputError("fibres.unreadable", message, file=path.name) from error
    if not of_model:
        message = f"the fibre muscles in {path.name} are of another model"
        raise InputError("fibres.model", message, file=path.name)
    return muscles


def _turn_rates(turns: Floats) -> sp.csr_array:
    """Return how the rotations of vectors w (t, 3) turn on with w, blocks (3 t, 3 t).

    exp(w + dw) = exp(J dw) exp(w), J = I + (1 - cos t)/t^2 [w] + (t - sin t)/t^3 [w]^2, t = |w|.
    """
    angle = np.linalg.norm(turns, axis=1)
    small = np.maximum(angle, 1e-4)
    first = (1.0 - np.cos(small)) / small**2
    second = (small - np.sin(small)) / small**3
    K = skew(turns)
    blocks = np.eye(3) + first[:, None, None] * K + second[:, None, None] * (K @ K)
    count = np.arange(len(turns))
    return sp.csr_array(sp.bsr_array((blocks, count, np.arange(len(turns) + 1))))
