"""Forces on flesh in motion: its inertia, and from outside gravity, wind and skin that is pulled.

One step of backward Euler is a minimum:

    E(y, a) + 1/(2 h^2) |y - z|^2_M + c/(2 h) |y - y_t|^2_M - f . y

(the incremental potential: Phace, eq. 11; Li et al. 2020, eq. 2). z = y_t + h v_t is where the
flesh would fly without forces, M the lumped mass, c the damping of motion in the head's frame, f
the forces from outside, in g mm/s^2, taken at the step's start. All are in the head's frame, where
the step leads: a rigidly moved world puts z there, so no fictitious forces are missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation
from typing_extensions import override

from solver.errors import InputError
from solver.fitting.face import Face
from solver.mechanics.boundary import straight
from solver.mechanics.flesh import Flesh
from solver.mechanics.terms import Springs
from solver.model import SubjectModel
from solver.neck.motion import grown_part
from solver.similarity import Similarity
from solver.surface import Floats, area_normals


def lumped_masses(flesh: Flesh, density: Floats) -> Floats:
    """Return every vertex's mass (p,) in g, a quarter of its tets'; ``density`` (n,) in g/mm^3."""
    quarters = np.repeat(density * flesh.volumes / 4.0, 4)
    return np.asarray(np.bincount(flesh.tets.ravel(), quarters, len(flesh.rest)), np.float64)


class Inertia(Springs):
    """Springs of inertia and damping on the free vertices, and a ``load`` (p, 3) that pulls.

    E = springs - sum_v load_v . (x_v - rest_v), with the load in Pa mm^2; all is zero until it is
    set.
    """

    def __init__(self, flesh: Flesh) -> None:
        self._rest = flesh.rest
        self._free = flesh.free
        super().__init__(flesh.free[:, None], flesh.rest[flesh.free], np.zeros(len(flesh.free)))
        self.release()

    @override
    def energy(self, x: Floats, controls: Floats) -> float:
        work = float((self.load * (x - self._rest))[self._free].sum())
        return super().energy(x, controls) - work

    @override
    def forces(self, x: Floats, controls: Floats) -> Floats:
        return super().forces(x, controls) - self.load[self.vertices]

    def release(self) -> None:
        """Take springs and load away."""
        self.stiffness, self.load = np.zeros(len(self._free)), np.zeros_like(self._rest)

    def launch(
        self, masses: Floats, y: Floats, flight: Floats, seconds: float, damping: float
    ) -> None:
        """Set the springs of a step: from y (p, 3), where ``flight`` (p, 3) is z.

        ``masses`` (p,) are in g, ``damping`` is in 1/s.
        """
        inertia = 1.0 / seconds**2
        drag = damping / seconds
        self.stiffness = (inertia + drag) * masses[self._free]
        self.centre = (inertia * flight + drag * y)[self._free] / (inertia + drag)


@dataclass(frozen=True)
class FleshMotion:
    """Flesh in the world, and the head, which takes the subject's frame there with scale 1."""

    x: Floats  # (p, 3) mm
    v: Floats  # (p, 3) mm/s
    head: Similarity

    @property
    def y(self) -> Floats:
        """Return the vertices (p, 3) in the head's frame."""
        return self.head.inverse()(self.x)


@dataclass(frozen=True)
class Drive:
    """Input of a moment."""

    time: float  # seconds
    A: Floats  # what drives the flesh: activations (n, 6) of each tet, or other controls of it
    jaw: Floats  # (5,)
    head: Similarity  # into the world
    objects: tuple[Floats, ...] = ()  # vertices (o, 3) in the world, mm
    # (p, 3) mm: how far a neck carries the flesh's vertices, in the head's frame, which those on
    # the cut planes follow; None without a neck
    carried: Floats | None = None

    def toward(self, other: Drive, part: float) -> Drive:
        """Return what to ask for ``part`` of the way to ``other``, the head turning steadily."""
        if part == 1.0:
            return other
        turn = Rotation.from_matrix(self.head.rotation.T @ other.head.rotation).as_rotvec()
        rotation = self.head.rotation @ Rotation.from_rotvec(part * turn).as_matrix()
        ends = ((each.A, each.jaw, each.head.shift, *each.objects) for each in (self, other))
        A, jaw, shift, *objects = straight(part, *ends)
        head = Similarity(1.0, np.asarray(rotation), shift)
        time = self.time + part * (other.time - self.time)
        carried = other.carried
        if self.carried is not None and other.carried is not None:
            carried = self.carried + part * (other.carried - self.carried)
        return Drive(time, A, jaw, head, tuple(objects), carried)


Vector = Floats | Sequence[float]

GRAVITY = (0.0, -9810.0, 0.0)  # on earth, with y up: mm/s^2
AIR = 1.2e-6  # density of air in g/mm^3
DRAG = 1.2  # coefficient of a plate across the wind (Hoerner 1965: 1.17)
SMALLEST_MM2 = 1e-12  # a smaller triangle, of vertices at one place, has no normal and no wind
MILLINEWTON = 1e3  # in g mm/s^2


class ExternalForce(Protocol):
    """A force on the flesh from outside."""

    def at(self, motion: FleshMotion, time: float, /) -> Floats:
        """Return the forces (p, 3) in the world at ``time`` in seconds, g mm/s^2."""


class Gravity(ExternalForce):
    """Weight, less the weight under which the neutral face was scanned: its shape is not to sag.

    ``masses`` (p,) are the vertices' in g, ``mm_s2`` (3,) is the acceleration in the world,
    ``scanned`` (3,) that of the neutral scan, in the head's frame.
    """

    def __init__(self, masses: Floats, mm_s2: Vector = GRAVITY, scanned: Vector = GRAVITY) -> None:
        self._masses = masses
        self._now = np.asarray(mm_s2, float)
        self._scanned = np.asarray(scanned, float)

    @override
    def at(self, motion: FleshMotion, _time: float, /) -> Floats:
        change = self._now - motion.head.rotation @ self._scanned
        return np.asarray(self._masses[:, None] * change)


class Wind(ExternalForce):
    """Wind on the face skin: rho/2 C A |w_n| w_n n on a triangle of area A and normal n.

    w_n is the part along n of the wind relative to the skin: it presses on one side and sucks on
    the other. ``m_s`` (3,) is its velocity in the world; ``gusts`` is the part of it that comes and
    goes, by three sines that ``seed`` chooses between two ``gust_hz``.
    """

    def __init__(
        self,
        face: Face,
        m_s: Vector,
        gusts: float = 0.0,
        seed: int = 0,
        gust_hz: tuple[float, float] = (0.4, 3.0),
    ) -> None:
        self._triangles = face.model.face_triangles
        self._embedding = face.face_embedding
        self._offset = face.face_offset
        self._mm_s = 1e3 * np.asarray(m_s, float)
        self._gusts = gusts
        random = np.random.default_rng(seed)
        self._hertz = random.uniform(*gust_hz, 3)
        self._phases = random.uniform(0.0, 2.0 * np.pi, 3)

    def velocity(self, time: float) -> Floats:
        """Return the wind (3,) at ``time`` in seconds, mm/s."""
        gust = np.sin(2.0 * np.pi * self._hertz * time + self._phases).mean()
        return np.asarray((1.0 + self._gusts * gust) * self._mm_s)

    @override
    def at(self, motion: FleshMotion, time: float, /) -> Floats:
        skin = self._embedding @ motion.x + motion.head.turn(self._offset)
        doubled = area_normals(skin, self._triangles)
        area = 0.5 * np.linalg.norm(doubled, axis=1)
        normal = 0.5 * doubled / np.maximum(area, SMALLEST_MM2)[:, None]
        moving = (self._embedding @ motion.v)[self._triangles].mean(axis=1)
        along = ((self.velocity(time) - moving) * normal).sum(axis=1)
        pressure = 0.5 * AIR * DRAG * np.abs(along) * along
        third = (pressure * area)[:, None] * normal / 3.0
        on_skin = np.zeros_like(skin)
        np.add.at(on_skin, self._triangles, third[:, None, :])
        return np.asarray(self._embedding.T @ on_skin)


class Pull(ExternalForce):
    """Skin that is pulled at a point, in the head's frame, as if by a patch that sticks to it.

    ``mn`` (3,) is the whole force in millinewton. It is spread over the skin within ``radius_mm``
    of the skin vertex number ``vertex``, and grows over ``ramp`` seconds from time zero. Raises
    :class:`InputError` (``force.point``) where no flesh is below that skin.
    """

    def __init__(
        self,
        model: SubjectModel,
        vertex: int,
        mn: Vector,
        *,
        radius_mm: float = 5.0,
        ramp: float = 0.0,
    ) -> None:
        skin = model.skin.vertices
        if vertex not in model.embedded:
            message = f"skin vertex {vertex} is on no flesh: it cannot be pulled"
            raise InputError("force.point", message)
        distance = np.linalg.norm(skin[model.embedded] - skin[vertex], axis=1)
        weights = np.maximum(1.0 - (distance / radius_mm) ** 2, 0.0) ** 2
        self._share = np.asarray(model.embedding.T @ (weights / weights.sum()))
        self._force = MILLINEWTON * np.asarray(mn, float)
        self._ramp = ramp

    @override
    def at(self, motion: FleshMotion, time: float, /) -> Floats:
        part = grown_part(time, self._ramp)
        return np.asarray(self._share[:, None] * (part * motion.head.rotation @ self._force))
