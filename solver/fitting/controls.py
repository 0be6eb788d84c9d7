"""Controls of a fit: one vector q of named blocks, with rest, bounds and units.

Activations of S, contractions along fibres or activations of fibre muscles, the jaw free or on its
tracks: a fit varies them all as one vector and finds its parts by name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from solver.errors import InputError
from solver.fitting.admissible import AdmissibleSet
from solver.mechanics.boundary import JAW_FREEDOM
from solver.mechanics.flesh import IDENTITY
from solver.mechanics.jaw_tracks import TRACK_FREEDOM, JawTracks
from solver.surface import Floats, Ints

# distance to the bounds of what is brought inside them, by that at rest
CLIPPED = 1e-4
# D: a radian of jaw counts as 100 mm, its motion at the chin
JAW_UNITS = np.array([100.0, 100.0, 1.0, 1.0, 1.0])


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
    admissible: AdmissibleSet | None = None  # the set that its activations stay in, if any


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
    def rest(self) -> Floats:
        """Return q (size,) of the neutral face."""
        return self.join([block.rest for block in self.blocks])

    @cached_property
    def lower(self) -> Floats:
        """Return the lower bounds (size,)."""
        return self._spread([block.lower for block in self.blocks])

    @cached_property
    def upper(self) -> Floats:
        """Return the upper bounds (size,)."""
        return self._spread([block.upper for block in self.blocks])

    @cached_property
    def is_bounded(self) -> bool:
        """Tell whether any entry has a bound."""
        return bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())

    @property
    def admissible(self) -> AdmissibleSet | None:
        """Return the set that the muscles' activations stay in, None if they are free."""
        return self.blocks[0].admissible

    @property
    def is_limited(self) -> bool:
        """Tell whether there are bounds of either sort."""
        return self.is_bounded or self.admissible is not None

    def clip(self, q: Floats) -> Floats:
        """Return q (size,) within the bounds."""
        out = np.clip(q, self.lower, self.upper) if self.is_bounded else q
        if self.admissible is None:
            return out
        out, muscles = out.copy(), self.muscles
        out[muscles] = self.admissible.nearest(out[muscles], CLIPPED)
        return out

    def limits(self, q: Floats, reach: float) -> tuple[Floats, Floats]:
        """Return the least and the greatest step from q (size,), of a length up to ``reach``."""
        longest = reach * self._reaches
        return np.maximum(self.lower - q, -longest), np.minimum(self.upper - q, longest)

    @cached_property
    def damping(self) -> Floats:
        """Return the diagonal of D^2 (size,): what damping weighs each entry of q by."""
        return self._spread([block.damping for block in self.blocks])

    @cached_property
    def _reaches(self) -> Floats:
        return self._spread([block.reach for block in self.blocks])

    def reach(self, step: Floats) -> float:
        """Return the length of a ``step`` (size,): 1 is what a linear model is surely good for."""
        return float((np.abs(step) / self._reaches).max())

    def part(self, name: str, q: Floats) -> Floats:
        """Return a view of a block in q (size,), in its shape."""
        return q[self[name]].reshape(self._shape(name))

    def places(self, name: str) -> Ints:
        """Return where a block's entries are in q, in its shape."""
        return np.arange(self.size)[self[name]].reshape(self._shape(name))

    @property
    def muscles(self) -> Ints:
        """Return where the controls of each muscle are in q, (m, entries of one)."""
        places = self.places(self.blocks[0].name)
        return places.reshape(len(places), -1)

    def _shape(self, name: str) -> tuple[int, ...]:
        return next(block.rest.shape for block in self.blocks if block.name == name)

    def split(self, q: Floats) -> list[Floats]:
        """Return views of q (size,) in the shapes of the blocks."""
        return [self.part(block.name, q) for block in self.blocks]

    def join(self, values: Sequence[Floats]) -> Floats:
        """Return q (size,) of the blocks' ``values``."""
        return np.concatenate([value.ravel() for value in values])

    def _spread(self, values: Sequence[Floats | float]) -> Floats:
        pairs = zip(values, self.blocks, strict=True)
        return self.join([np.broadcast_to(value, block.rest.shape) for value, block in pairs])


# changes that count as a step of reach 1: of an activation's entry, and of the jaw's angles in rad
ACTIVATION_REACH, TURN_REACH = 0.4, 0.1
JAW_DAMPING = 1e-3  # weight of D^2


def jaw_block() -> Block:
    """Return the block of the jaw b (5,): two angles, rad, and a translation, mm."""
    reach = np.array([TURN_REACH, TURN_REACH, np.inf, np.inf, np.inf])
    damping = JAW_UNITS**2 * JAW_DAMPING
    return Block("jaw", np.zeros(JAW_FREEDOM), damping, reach, units=JAW_UNITS)


def track_block(tracks: JawTracks) -> Block:
    """Return the block of a jaw on its tracks (3,): an angle, rad, and two slides, mm."""
    units = np.array([JAW_UNITS[0], 1.0, 1.0])
    reach = np.array([TURN_REACH, np.inf, np.inf])
    rest, damping = np.zeros(TRACK_FREEDOM), units**2 * JAW_DAMPING
    return Block("tracks", rest, damping, reach, tracks.lower, tracks.upper, units)


def fibre_block(muscles: int) -> Block:
    """Return the block of fibre muscles' activations (m,), relaxed at rest."""
    return Block("fibres", np.zeros(muscles), reach=ACTIVATION_REACH, lower=0.0, upper=1.0)


def activation_block(muscles: int, admissible: AdmissibleSet | None = None) -> Block:
    """Return the block of activations (m, 6), free unless there is a set that they stay in."""
    rest = np.tile(IDENTITY, (muscles, 1))
    return Block("activations", rest, reach=ACTIVATION_REACH, admissible=admissible)


@cache
def pose_layout(muscles: int) -> Layout:
    """Return the layout of (a, b): ``activations`` (m, 6) and ``jaw`` (5,)."""
    return Layout((activation_block(muscles), jaw_block()))
