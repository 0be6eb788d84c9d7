"""Figures of a rig's expressions: skin, muscles, jaw, flesh, contact, round trip and solve."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from solver.anatomy.action_units import actions_of
from solver.anatomy.embedding import at_nearest
from solver.anatomy.jaw_openers import opener_contractions
from solver.anatomy.muscle_weights import is_within, volumes_by_muscle
from solver.anatomy.physiology import JAW_RANGES, SHORTEST, THICKEST
from solver.contact.crossing import Crossing, crossing
from solver.contact.mouth import Mouth
from solver.errors import SolveError
from solver.fitting.contraction import Contraction
from solver.fitting.drives.six_numbers import SixNumbers
from solver.fitting.face import Face, Pose
from solver.fitting.geometry_information import Linearisation, MuscleInformation
from solver.fitting.stretches import determinants, matrices
from solver.mechanics.boundary import FreeJaw, five_numbers
from solver.mechanics.linear import LinearSolver, analyse
from solver.mechanics.newton import Factorization
from solver.model import SubjectModel
from solver.rig.expression import ExpressionFit
from solver.rig.report.prime_movers import Movers, Said, movers, rank_contractions
from solver.rig.rig import Rig
from solver.rig.round_trip import round_trip
from solver.surface import Floats, Ints

# Muscles and jaw of a fit against those of a living face.


@dataclass(frozen=True)
class MuscleLimits:
    """Limits of a muscle's activation, wider than those by which fits are bounded."""

    shortest: float = SHORTEST  # stretch in any direction
    longest: float = THICKEST
    longest_fibre: float = 1.1  # a muscle pulls: one whose fibres lengthen by more pushes
    volumes: tuple[float, float] = (0.7, 1.3)  # by that at rest; water does not go
    least_flesh_mm3: float = 10.0  # with less of S a muscle moves nothing, and is not judged


@dataclass(frozen=True)
class ExpressionMuscles:
    """The m muscles of one expression, each array (m,)."""

    shortest: Floats  # least eigenvalue of S(a_j)
    longest: Floats  # greatest eigenvalue
    volume: Floats  # det S(a_j)
    fibres: Floats  # d^T S(a_j) d along fibres d, mean over the muscle's flesh; NaN without any
    flesh_mm3: Floats  # how much of the flesh is the muscle's
    limits: MuscleLimits = MuscleLimits()

    @property
    def is_judged(self) -> NDArray[np.bool_]:
        """Return which muscles (m,) have flesh enough to be judged."""
        return np.asarray(self.flesh_mm3 >= self.limits.least_flesh_mm3)

    @property
    def contraction(self) -> Floats:
        """Return the contractions (m,) of :mod:`solver.fitting.contraction`."""
        return 1.0 - self.fibres

    def faults(self, muscle: int) -> list[str]:
        """Return in plain words what a muscle does that muscles cannot do."""
        return [each.words for each in self.said("", muscle)]

    def said(self, name: str, muscle: int) -> list[Said]:
        """Return what a muscle does that muscles cannot do, under its ``name``.

        The amount is by how much a limit is passed, as a logarithm of the stretch or the volume.
        """
        limits = self.limits
        if not self.is_judged[muscle]:
            return []
        least = self.shortest[muscle]
        most = self.longest[muscle]
        fibres = self.fibres[muscle]
        volume = self.volume[muscle]
        low, high = limits.volumes
        if least <= 0.0:
            shrunk = (np.inf, "is turned inside out")
            sized = (0.0, "")
        else:
            shrunk = limits.shortest / least, f"shrinks to {100 * least:.0f} % in one direction"
            sized = max(volume / high, low / volume), f"has {100 * volume:.0f} % of its volume"
        passed = (
            shrunk,
            (most / limits.longest, f"stretches to {100 * most:.0f} % in one direction"),
            (fibres / limits.longest_fibre, f"pushes: its fibres lengthen to {100 * fibres:.0f} %"),
            sized,
        )
        return [Said(name, words, float(np.log(by))) for by, words in passed if by > 1.0]

    @property
    def inside_out(self) -> Ints:
        """Return the numbers of the muscles that are turned inside out."""
        return np.flatnonzero((self.shortest <= 0.0) & self.is_judged)


def muscles(model: SubjectModel, volumes: Floats, S: sp.csr_array, a: Floats) -> ExpressionMuscles:
    """Return the figures of activations ``a`` (m, 6); ``volumes`` (n,) are the tets' at rest."""
    tensors = matrices(a)
    shortest, _, longest = np.asarray(np.linalg.eigvalsh(tensors), np.float64).T
    fibres = 1.0 - Contraction.of(model, volumes, S)(a)
    return ExpressionMuscles(
        shortest, longest, determinants(a), fibres, volumes_by_muscle(volumes, S)
    )


@dataclass(frozen=True)
class StrayOptions:
    """Limits beyond which a muscle's flesh counts as outside of the muscle."""

    # its tet's middle lies further from the muscle's surface: people's muscles vary by millimetres
    beyond_mm: float = 5.0
    most: float = 0.1  # part of a muscle's flesh that may be


def stray_parts(
    model: SubjectModel, volumes: Floats, S: sp.csr_array, options: StrayOptions = StrayOptions()
) -> dict[str, float]:
    """Return whole muscle -> the part of its flesh that S has outside of it, the worst first.

    ``volumes`` (n,) are the tets' at rest. Muscles without a surface are left out.
    """
    entries = S.tocoo()
    centres = model.tet_centres
    found = {}
    flesh = entries.data * volumes[entries.row]
    whole_of = np.array(["", *model.muscle_groups])[entries.col]
    for whole, surface in model.muscles.items():
        own = (whole_of == whole) & (entries.data > 0.0)
        if own.any():
            inside = is_within(centres[entries.row[own]], surface, options.beyond_mm)
            found[whole] = float(flesh[own][~inside].sum() / flesh[own].sum())
    return dict(sorted(found.items(), key=lambda item: -item[1]))


JAW_WORDS = {
    "opening_deg": ("closes by {:.0f}°", "opens by {:.0f}°"),
    "opening_mm": ("closes {:.1f} mm beyond rest", "opens by {:.0f} mm"),
    "sideways_mm": ("goes {:.0f} mm to the right", "goes {:.0f} mm to the left"),
    "condyles_forward_mm": ("is {:.1f} mm behind its sockets", "leaves its sockets by {:.0f} mm"),
    "condyles_down_mm": ("is {:.1f} mm up in its sockets", "drops from its sockets by {:.0f} mm"),
}


@dataclass(frozen=True)
class JawFigures:
    """The mandible's motion from rest: rotation in degrees, ``point`` and condyles in mm.

    ``opening_mm`` (down) and ``sideways_mm`` (to the subject's left) are taken at ``point``, the
    ``lower incisors`` where the model names lower teeth, else the ``chin``. ``openers`` are
    the muscles that open the jaw -> the part of their length by which they shorten for that.
    """

    point: str
    opening_deg: float
    opening_mm: float
    sideways_mm: float
    condyles_forward_mm: float
    condyles_down_mm: float
    openers: dict[str, float] = field(default_factory=dict)

    def faults(self) -> list[str]:
        """Return in plain words what the jaw does that jaws cannot do."""
        return [
            JAW_WORDS[name][value > 0].format(abs(value))
            for name, (least, most) in JAW_RANGES.items()
            if not least <= (value := getattr(self, name)) <= most
        ]


def jaw_motion(model: SubjectModel, mandible: Floats) -> JawFigures:
    """Return what a rigid motion (4, 4) of the mandible comes to."""
    b = five_numbers(model.jaw, mandible)
    front = model.jaw_front
    moved = front @ mandible[:3, :3].T + mandible[:3, 3]
    motion = (moved - front)[0] @ model.jaw.axes.T
    return JawFigures(
        point="lower incisors" if len(model.lower_teeth) else "chin",
        opening_deg=float(np.degrees(b[0])),
        opening_mm=float(-motion[1]),
        sideways_mm=float(motion[0]),
        condyles_forward_mm=float(b[4]),
        condyles_down_mm=float(-b[3]),
        openers=opener_contractions(model.jaw, mandible),
    )


@dataclass(frozen=True)
class FleshCheck:
    """The tets of one expression."""

    inverted: int  # number of tets with det F <= 0
    det_least: float  # volumes of the flattest and the most swollen tet by their rest volumes
    det_most: float
    flattest: int  # their numbers
    swollen: int
    volume_percent: float  # change of the whole flesh's volume
    residual: float  # |grad E| over the nodal forces at unit strain
    minimum: bool  # whether the Hessian is positive definite


@dataclass(frozen=True)
class ExpressionCheck:
    """The checks of one expression."""

    muscles: ExpressionMuscles
    movers: Movers  # who contracts, by the actions that the expression's name speaks for
    asymmetry_mm: float | None  # of the scan's motion; None where it shows nothing
    jaw: JawFigures
    flesh: FleshCheck | None  # None where the rig does not hold the tets
    crossing: Crossing | None  # of the fitted skin; None where the model names no lips
    scan_crossing: Crossing | None  # of the scan; None too where it has holes


@dataclass(frozen=True)
class Certificate:
    """The checks of a rig: expression -> check, and the ``settings`` of the job that made it.

    ``information`` is that of the training scans on each muscle; None where no state is known.
    ``strayed`` is that of :func:`stray_parts`.
    """

    expressions: dict[str, ExpressionCheck]
    settings: dict[str, Any]
    information: MuscleInformation | None = None
    strayed: dict[str, float] = field(default_factory=dict)


# called before each expression with its name and number
Listener = Callable[[str, int], None]


def with_round_trips(
    face: Face, fits: tuple[ExpressionFit, ...], listen: Listener | None = None
) -> tuple[ExpressionFit, ...]:
    """Return the fits with their round trips; those that have one keep it."""
    # one for all, which knows its rest
    done = list(fits)
    free = face if face.layout.bounds.is_free else face.driven_by(SixNumbers()).with_free_jaw()
    for number, fit in enumerate(fits):
        if fit.round_trip is None:
            if listen:
                listen(fit.name, number)
            pose = Pose(fit.activations, fit.jaw)
            skin = fit.skin[face.model.face]
            # what was fitted freely is fitted freely again
            own = face if face.layout.bounds.contains(pose.vector()) else free
            done[number] = replace(fit, round_trip=round_trip(own, pose, skin))
    return tuple(done)


def certify(
    face: Face, rig: Rig, settings: dict[str, Any], information: MuscleInformation | None = None
) -> Certificate:
    """Check every expression of a rig of ``face``; ``settings`` are JSON values.

    ``information`` is that of a rig of the same S and training scans, where there is one.
    """
    face = face.with_weights(rig.weights).with_free_jaw()
    mouth = Mouth.of(face.model)
    # the signs of pivots near buckling take double precision, whatever the fit had
    linear = analyse(face.flesh.hessian(face.model.rest, face.flesh.passive()))
    checks = {fit.name: _check(face, fit, mouth, linear) for fit in rig.expressions}
    outside = stray_parts(face.model, face.flesh.volumes, rig.weights)
    return Certificate(checks, settings, information or muscle_information(face, rig), outside)


def muscle_information(face: Face, rig: Rig) -> MuscleInformation | None:
    """Return the information of a rig's training scans on the muscles of ``face``, with its S."""
    linearisation = Linearisation(face)
    scanned = scan_information(linearisation, rig)
    if not scanned:
        return None
    posterior = linearisation.posterior(scanned)
    return MuscleInformation.of(posterior, linearisation.modes.places, len(scanned))


def scan_information(linearisation: Linearisation, rig: Rig) -> list[Floats]:
    """Return the information of every training scan whose state is known and settles."""
    face = linearisation.face
    found = []
    for fit in rig.expressions:
        if fit.role != "train" or fit.status == "failed" or fit.x is None:
            continue
        state = face.settle(Pose(fit.activations, fit.jaw), fit.x)
        seen = fit.seen(face.model.face)
        if state is None or not seen.any():
            continue
        with contextlib.suppress(SolveError):  # the certificate has no figures of it then
            found.append(linearisation.information(state, seen))
    return found


def _check(
    face: Face, fit: ExpressionFit, mouth: Mouth | None, linear: LinearSolver
) -> ExpressionCheck:
    a = face.flesh_controls(fit.activations)
    found = muscles(face.model, face.flesh.volumes, face.S, fit.activations)
    return ExpressionCheck(
        found,
        movers(
            rank_contractions(face.model.muscle_names, found.contraction, found.is_judged),
            dict(zip(face.model.muscle_names, face.model.muscle_groups, strict=True)),
            actions_of(fit.name),
        ),
        asymmetry_mm(face.model, np.where(np.isfinite(fit.error_mm)[:, None], fit.target, np.nan)),
        jaw_motion(face.model, FreeJaw(face.model.jaw).matrix(fit.jaw)),
        None if fit.x is None else check_flesh(face, a, fit.x, linear),
        None if mouth is None else crossing(mouth, fit.skin),
        crossing(mouth, fit.target) if mouth and np.isfinite(fit.target).all() else None,
    )


def check_flesh(face: Face, a: Floats, x: Floats, linear: LinearSolver) -> FleshCheck:
    """Check vertices ``x`` (p, 3) under activations ``a`` (n, 6); ``linear`` finds the inertia."""
    flesh = face.flesh
    det = flesh.jacobians(x)
    residual = np.linalg.norm(flesh.gradient(x, a)) / flesh.force_scale
    return FleshCheck(
        inverted=int((det <= 0.0).sum()),
        det_least=float(det.min()),
        det_most=float(det.max()),
        flattest=int(det.argmin()),
        swollen=int(det.argmax()),
        volume_percent=float(100.0 * (det @ flesh.volumes / flesh.volumes.sum() - 1.0)),
        residual=float(residual),
        minimum=Factorization(flesh, linear, x, a).projection == 0,
    )


# How alike both sides of a face move: an expression's motion against its mirror image.


@dataclass(frozen=True)
class SymmetryOptions:
    """Bounds within which both sides move alike."""

    percentile: float = 99.0  # of the face's vertices: a wink moves few of them
    most_mm: float = 0.5  # by which they are off the mirror image


SYMMETRY = SymmetryOptions()


def asymmetry_mm(
    model: SubjectModel, skin: Floats, options: SymmetryOptions = SYMMETRY
) -> float | None:
    """Return how far the motion of the face to ``skin`` (v, 3) is off its mirror image.

    That is a percentile over the face's vertices, those left out that ``skin`` does not show (NaN);
    None where none is left. The mirror is the jaw's middle plane.
    """
    neutral = model.skin.vertices
    across = model.jaw.axes[0]
    motion = skin - neutral
    places = neutral[model.face]
    mirrored = places - 2.0 * np.outer((places - model.jaw.origin) @ across, across)
    other = at_nearest(mirrored, model.skin, motion)
    off = motion[model.face] - other + 2.0 * np.outer(other @ across, across)
    known = np.linalg.norm(off, axis=1)
    known = known[np.isfinite(known)]
    return float(np.percentile(known, options.percentile)) if len(known) else None
