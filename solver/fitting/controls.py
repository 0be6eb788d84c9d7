"""Controls of a fit: one vector q of named blocks, with rest, bounds and units.

The first block drives the muscles (:mod:`solver.fitting.drives`), one or more move a
:class:`Joint`. A fit varies them all as one vector and finds its parts by name or by role.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Literal, Protocol

import numpy as np

from solver.errors import InputError, SolveError
from solver.fitting.interior_point import Bounds, FeasibleSet
from solver.fitting.steps import BoxSteps, FeasibleStepOptions, FreeSteps, SetSteps, StepModel
from solver.mechanics.boundary import JAW_FREEDOM, FreeJaw, JawMotion
from solver.mechanics.jaw_tracks import TRACK_FREEDOM, JawTracks
from solver.model import JawFrame
from solver.surface import Floats, Ints

# what a change of 1 rad counts as, in mm: the motion of a chin
ANGLE_UNIT = 100.0

Role = Literal["muscles", "joint", "values"]


class ShapePenalty(Protocol):
    """The price of muscles' values a (m, k) as shapes, beside their distance from rest.

    ``w_v`` weighs lost or gained volume, ``w_e`` stretches that turn flesh inside out.
    """

    def value(self, a: Floats, w_v: float, w_e: float) -> float:
        """Return the price."""

    def gradient(self, a: Floats, w_v: float, w_e: float) -> Floats:
        """Return its derivative (m, k)."""

    def curvature(self, a: Floats, w_v: float, w_e: float) -> Floats:
        """Return its positive semi-definite Gauss-Newton Hessian of each muscle, (m, k, k)."""


@dataclass(frozen=True)
class Spread:
    """Standard deviations of what no known expression does, in the units of a block."""

    template: Floats | float = 0.03  # where a template's expressions are known
    scans: Floats | float = 0.03  # where a person's few scans are
    nothing: Floats | float = 0.6  # where none is


@dataclass(frozen=True)
class Block:
    """A named part of q; ``rest`` has its shape, everything else broadcasts to it."""

    name: str
    rest: Floats
    damping: Floats | float = 1.0  # what Levenberg-Marquardt weighs a squared change by
    reach: Floats | float = np.inf  # the change up to which a linear model is surely good
    lower: Floats | float = -np.inf
    upper: Floats | float = np.inf
    units: Floats | float = 1.0  # what a change of 1 counts as in a regulariser
    usual: Floats | float = 0.2  # a change that is nothing special
    spread: Spread = Spread()
    role: Role = "values"
    feasible: FeasibleSet | None = None  # the set that muscles' values stay in, if any
    penalty: ShapePenalty | None = None  # None for values that are no shapes


@dataclass(frozen=True)
class Layout:
    """The blocks of q in turn: ``layout["jaw"]`` is the slice of q (size,) that is the jaw."""

    blocks: tuple[Block, ...]

    @cached_property
    def _places(self) -> dict[str, slice]:
        ends = np.cumsum([block.rest.size for block in self.blocks]).tolist()
        return {b.name: slice(i - b.rest.size, i) for b, i in zip(self.blocks, ends, strict=True)}

    def __getitem__(self, name: str) -> slice:
        """Return where a block is; raises :class:`InputError` (``face.layout``) without it."""
        if name not in self._places:
            words = f"the face is moved by {' and '.join(self._places)}, not by {name}"
            message = f"{words}: this is for muscles of six numbers and a free jaw"
            raise InputError("face.layout", message, found=list(self._places), expected=name)
        return self._places[name]

    @property
    def size(self) -> int:
        """Return the number of entries of q."""
        return sum(block.rest.size for block in self.blocks)

    @cached_property
    def drive(self) -> Block:
        """Return the block that drives the muscles."""
        return next(block for block in self.blocks if block.role == "muscles")

    @cached_property
    def joints(self) -> tuple[Block, ...]:
        """Return the blocks that move joints."""
        return tuple(block for block in self.blocks if block.role == "joint")

    @cached_property
    def rest(self) -> Floats:
        """Return q (size,) of the neutral face."""
        return self.join([block.rest for block in self.blocks])

    @cached_property
    def lower(self) -> Floats:
        """Return the lower bounds (size,) of every entry by itself."""
        return self._broadcast([block.lower for block in self.blocks])

    @cached_property
    def upper(self) -> Floats:
        """Return the upper bounds (size,)."""
        return self._broadcast([block.upper for block in self.blocks])

    @cached_property
    def bounds(self) -> Bounds:
        """Return the bounds of q: boxes, and the set that the muscles' values stay in."""
        return Bounds(self.lower, self.upper, self.muscles, self.drive.feasible)

    def steps(
        self,
        hessian: Floats,
        gradient: Floats,
        q: Floats,
        reach: float = np.inf,
        options: FeasibleStepOptions | None = None,
    ) -> StepModel:
        """Return the steps of a quadratic model at q, free or within the bounds.

        ``hessian`` is (size, size), ``gradient`` and q are (size,); steps for another gradient
        follow the best one for this. Steps in a box keep to a length of ``reach``; others are to be
        cut by the caller.
        """
        bounds = self.bounds
        if bounds.feasible is not None:
            return SetSteps(bounds, hessian, gradient, q, options or FeasibleStepOptions())
        if bounds.is_box:
            longest = reach * self._reaches
            limits = np.maximum(bounds.lower - q, -longest), np.minimum(bounds.upper - q, longest)
            return BoxSteps(hessian, gradient, limits)
        return FreeSteps(hessian)

    @cached_property
    def damping(self) -> Floats:
        """Return the diagonal of D^2 (size,): what damping weighs each entry of q by."""
        return self._broadcast([block.damping for block in self.blocks])

    def spread(self, known: Literal["template", "scans", "nothing"]) -> Floats:
        """Return the standard deviations (size,) of what no known expression does."""
        return self._broadcast([getattr(block.spread, known) for block in self.blocks])

    @cached_property
    def usual(self) -> Floats:
        """Return the changes (size,) that are nothing special."""
        return self._broadcast([block.usual for block in self.blocks])

    @cached_property
    def _reaches(self) -> Floats:
        return self._broadcast([block.reach for block in self.blocks])

    def reach(self, step: Floats) -> float:
        """Return the length of a ``step`` (size,): 1 is what a linear model is surely good for."""
        return float((np.abs(step) / self._reaches).max())

    def part_within(self, trust: float, step: Floats) -> float:
        """Return the part of a ``step`` (size,) that is no longer than ``trust``, 1 being all.

        It is cut as a whole: with its turn cut alone, a jaw would be shifted in its place.
        """
        return 1.0 / max(self.reach(step) / trust, 1.0)

    def part(self, name: str, q: Floats) -> Floats:
        """Return a view of a block in q (size,), in its shape."""
        return q[self[name]].reshape(self._shape(name))

    def places(self, name: str) -> Ints:
        """Return where a block's entries are in q, in its shape."""
        return np.arange(self.size)[self[name]].reshape(self._shape(name))

    @cached_property
    def muscles(self) -> Ints:
        """Return where the controls of each muscle are in q, (m, entries of one)."""
        places = self.places(self.drive.name)
        return places.reshape(len(places), -1)

    @cached_property
    def joint_places(self) -> Ints:
        """Return where the numbers of the joints are in q, in the order of a pose's b."""
        return np.concatenate([self.places(block.name) for block in self.joints])

    @cached_property
    def joint_units(self) -> Floats:
        """Return what a change of 1 of each of these numbers counts as."""
        spread = [np.broadcast_to(block.units, block.rest.shape) for block in self.joints]
        return np.concatenate(spread)

    def _shape(self, name: str) -> tuple[int, ...]:
        return next(block.rest.shape for block in self.blocks if block.name == name)

    def split(self, q: Floats) -> list[Floats]:
        """Return views of q (size,) in the shapes of the blocks."""
        return [self.part(block.name, q) for block in self.blocks]

    def join(self, values: Sequence[Floats]) -> Floats:
        """Return q (size,) of the blocks' ``values``."""
        return np.concatenate([value.ravel() for value in values])

    def _broadcast(self, values: Sequence[Floats | float]) -> Floats:
        pairs = zip(values, self.blocks, strict=True)
        return self.join([np.broadcast_to(value, block.rest.shape) for value, block in pairs])


# What a caller hands to a face as a pose. Fits, which step within the bounds, pass by.


class PoseError(InputError, SolveError):
    """A pose has the wrong shape or is not finite: to a fit, a step that went too far."""


def check_pose(a: Floats, b: Floats, layout: Layout, names: Sequence[str]) -> None:
    """Raise :class:`PoseError` (``face.pose``) unless a and b are a ``layout``'s blocks, finite.

    ``names`` are those of the muscles, if it is they that a drives.
    """
    joints = " and ".join(block.name for block in layout.joints)
    muscles = layout.drive
    units = layout.joint_units
    for name, value, shape in ((muscles.name, a, muscles.rest.shape), (joints, b, units.shape)):
        if np.shape(value) != shape:
            message = f"the shape of a pose's {name} is {np.shape(value)}, not {shape}"
            if value is b and np.shape(b) == (JAW_FREEDOM,):
                message += ": face.pose_of(a, jaw) takes a jaw's five numbers"
            raise PoseError("face.pose", message)
    for j in np.flatnonzero(~np.isfinite(a.reshape(len(a), -1)).all(axis=1))[:1]:
        name = names[j] if len(names) == len(a) else f"number {j}"
        raise PoseError("face.pose", f"the activation of {name} is not finite: {a[j]}")
    if not np.isfinite(b).all():
        raise PoseError("face.pose", f"the jaw is not finite: {b}")
    angles = b[units == ANGLE_UNIT]
    if np.abs(angles).max(initial=0.0) > np.pi / 2.0:
        turns = " and ".join(f"{angle:g}" for angle in angles)
        message = f"the jaw turns by {turns} rad: degrees? (np.radians makes radians)"
        raise PoseError("face.pose", message)


# Joints of a face: bones that move by some of the controls.


JAW_UNITS = np.array([ANGLE_UNIT, ANGLE_UNIT, 1.0, 1.0, 1.0])
TURN_REACH = 0.1  # rad
JAW_DAMPING = 1e-3  # weight of D^2


@dataclass(frozen=True)
class Joint:
    """A bone's ``motion`` by the numbers of a ``block``."""

    motion: JawMotion
    block: Block
    is_free: bool  # the numbers are those that rigs hold, and the skin alone says where it is


def free_jaw(frame: JawFrame) -> Joint:
    """Return the jaw by b (5,): two angles, rad, and a translation, mm."""
    return Joint(FreeJaw(frame), jaw_block(), is_free=True)


def jaw_on_tracks(tracks: JawTracks) -> Joint:
    """Return the jaw on its tracks by (3,): an angle, rad, and two slides, mm."""
    units = np.array([ANGLE_UNIT, 1.0, 1.0])
    block = Block(
        "tracks",
        np.zeros(TRACK_FREEDOM),
        damping=units**2 * JAW_DAMPING,
        reach=np.array([TURN_REACH, np.inf, np.inf]),
        lower=tracks.lower,
        upper=tracks.upper,
        units=units,
        usual=np.array([0.2, 3.0, 3.0]),
        spread=Spread(*map(_on_tracks, (0.03, 0.06, 0.2), (0.5, 1.0, 3.0))),
        role="joint",
    )
    return Joint(tracks, block, is_free=False)


@cache
def jaw_block() -> Block:
    """Return the block of the free jaw."""
    loose = np.array([0.2, 0.1, 3.0, 3.0, 3.0])
    return Block(
        "jaw",
        np.zeros(JAW_FREEDOM),
        damping=JAW_UNITS**2 * JAW_DAMPING,
        reach=np.array([TURN_REACH, TURN_REACH, np.inf, np.inf, np.inf]),
        units=JAW_UNITS,
        usual=loose,
        spread=Spread(
            np.array([0.03, 0.03, 0.5, 0.5, 0.5]), np.array([0.06, 0.03, 1.0, 1.0, 1.0]), loose
        ),
        role="joint",
    )


def _on_tracks(angle: float, slide: float) -> Floats:
    return np.array([angle, slide, slide])
