"""The mandible on its tracks: three numbers, which no joint of a jaw can leave.

q = (theta, s_L, s_R) opens by theta and slides the left and the right condyle along its track, mm
(Sifakis, Neverov, Fedkiw 2005). With u the unit vector through the condyles at rest to the
subject's left, v along the tracks to the front, n = u x v down from them, m between the condyles
and l their distance,

    c(s) = sin(k s)/k v + (1 - cos(k s))/k n        a condyle's way: straight where k = 0
    d = (c(s_L) - c(s_R)) / l,   a = sqrt(1 - d^2) u + d
    x -> R_ua R_u(theta) (x - m) + m + (c(s_L) + c(s_R)) / 2

with R_ua the shortest rotation of u to a. So the condyles stay l apart, half way between them
nothing moves along u, and with straight tracks nothing leaves the plane of u and v: the published
equalities hold by construction, and its inequalities are bounds on q. Then R_ua turns about n, so
that the five numbers of a free jaw (:class:`~solver.model.JawFrame`) can say every such motion.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import TypeAlias

import numpy as np
from scipy.optimize import nnls
from typing_extensions import override

from solver.mechanics.boundary import JawMotion, rotation
from solver.model import JawFrame
from solver.similarity import weighted_motion
from solver.surface import Floats

TRACK_FREEDOM = 3  # the angle, and how far each condyle slid
NEAREST_STEPS = 20  # most steps of the search for a jaw
NEAREST = 1e-9  # its last step, rad and mm


@dataclass(frozen=True)
class JawTrackOptions:
    """Choice of tracks, and what counts as a jaw's motion among a template's shapes."""

    curved: bool = False  # the slope grows along the track
    retrusion_mm: float = 0.0  # of a condyle behind its rest
    length_mm: float = 20.0  # where no shape tells: Muto and Kanazawa 1996
    slope_deg: float = 35.0
    opening_deg: float = 50.0  # widest
    least_mm: float = 3.0  # motion of the jaw, at most, of a shape that counts
    least_slide_mm: float = 1.0  # of a condyle from which a shape tells the slope
    rigid: float = 0.05  # rms of what is no rigid motion, as part of it
    sideways: float = 0.2  # of a slide, as part of it, from which it is none along tracks
    spread: float = 0.25  # of the slides, as part of the longest, that tells a curve


TRACKS = JawTrackOptions()


# the rotation, the slide, and both's derivatives
_Motion: TypeAlias = tuple[Floats, Floats, tuple[Floats, Floats]]


@dataclass(frozen=True)
class JawTracks(JawMotion):
    """Tracks of the condyles: a :class:`~solver.mechanics.boundary.JawMotion` by q (3,)."""

    frame: JawFrame
    slope: float  # of v below the frame's third axis, at rest, rad
    apart: float  # l, mm
    length: float  # the furthest slide, mm
    opening: float  # the greatest theta, rad
    bend: float = 0.0  # k, 1/mm
    retrusion: float = 0.0  # how far a condyle may go behind its rest, mm
    # the last motion that was asked for: a fit asks for the same in all of a step
    _last: list[tuple[Floats, _Motion]] = field(init=False, default_factory=list, compare=False)

    @classmethod
    def of(cls, frame: JawFrame) -> JawTracks | None:
        """Return the tracks that a model's jaw has of its own; None in models made before them."""
        return cls(frame, **asdict(frame.tracks)) if frame.tracks else None

    @property
    def lower(self) -> Floats:
        """Return the least q."""
        return np.array([0.0, -self.retrusion, -self.retrusion])

    @property
    def upper(self) -> Floats:
        """Return the greatest q."""
        return np.array([self.opening, self.length, self.length])

    @override
    def matrix(self, b: Floats) -> Floats:
        R, slide, _ = self._motion(b)
        out = np.eye(4)
        m = self.frame.origin
        out[:3, :3] = R
        out[:3, 3] = m + slide - R @ m
        return out

    @override
    def move(self, points: Floats, b: Floats) -> Floats:
        R, slide, _ = self._motion(b)
        return np.asarray((points - self.frame.origin) @ R.T + self.frame.origin + slide)

    @override
    def jacobian(self, points: Floats, b: Floats) -> Floats:
        """Return the derivative (n, 3, 3)."""
        _, _, (rates, slides) = self._motion(b)
        arms = points - self.frame.origin
        return np.asarray(np.einsum("qij,nj->niq", rates, arms) + slides.T)

    def departure(self, motion: Floats) -> float:
        """Return how far the worse condyle is from its track, mm, after a ``motion`` (4, 4).

        A condyle beyond an end of its track is as far away as from that end. To the side, both are
        where the point half way between them is: a jaw on its tracks that slides one condyle alone
        draws both a little to the middle.
        """
        u, m, (v, n) = self.frame.axes[0], self.frame.origin, self._directions
        sideways = float((motion[:3, :3] @ m + motion[:3, 3] - m) @ u)
        most = 0.0
        for side in (0.5, -0.5):
            rest = m + side * self.apart * u
            gone = motion[:3, :3] @ rest + motion[:3, 3] - rest
            along = gone @ v
            below = gone @ n
            # the nearest point of a circle's arc is at the angle of the point
            angle = np.arctan2(self.bend * along, 1.0 - self.bend * below)
            s = angle / self.bend if self.bend else along
            nearest, _ = self._way(float(np.clip(s, -self.retrusion, self.length)))
            missed = gone - nearest
            missed += (sideways - missed @ u) * u
            most = max(most, float(np.linalg.norm(missed)))
        return most

    @property
    def _directions(self) -> tuple[Floats, Floats]:
        """Return v and n."""
        down = -self.frame.axes[1]
        ahead = self.frame.axes[2]
        v = np.cos(self.slope) * ahead + np.sin(self.slope) * down
        return v, np.cos(self.slope) * down - np.sin(self.slope) * ahead

    def _motion(self, b: Floats) -> _Motion:
        """Return the rotation, the slide, and both's derivatives by q, (3, 3, 3) and (3, 3)."""
        for before, found in self._last:
            if np.array_equal(before, b):
                return found
        found = self._motion_anew(b)
        self._last[:] = [(b.copy(), found)]
        return found

    def _motion_anew(self, b: Floats) -> _Motion:
        u = self.frame.axes[0]
        (left, by_left), (right, by_right) = self._way(b[1]), self._way(b[2])
        open_, by_angle = rotation(u, b[0])
        d = (left - right) / self.apart
        c = np.sqrt(1.0 - d @ d)
        K = np.outer(d, u) - np.outer(u, d)  # (u x d) x
        turn = np.eye(3) + K + K @ K / (1.0 + c)
        rates = [turn @ by_angle]
        for rate in (by_left / self.apart, -by_right / self.apart):
            dK = np.outer(rate, u) - np.outer(u, rate)
            dc = -(d @ rate) / c
            by_slide = dK + (dK @ K + K @ dK) / (1.0 + c) - K @ K * (dc / (1.0 + c) ** 2)
            rates.append(by_slide @ open_)
        slides = np.stack([np.zeros(3), 0.5 * by_left, 0.5 * by_right])
        return turn @ open_, 0.5 * (left + right), (np.stack(rates), slides)

    def _way(self, s: float) -> tuple[Floats, Floats]:
        """Return c(s) and its derivative."""
        v, n = self._directions
        along = s * np.sinc(self.bend * s / np.pi)
        angle = self.bend * s
        # (1 - cos k s) / k without division by zero
        below = 0.5 * self.bend * s * s * np.sinc(0.5 * angle / np.pi) ** 2
        return along * v + below * n, np.cos(angle) * v + np.sin(angle) * n


def tracks_of_shapes(
    frame: JawFrame,
    apart: float,
    teeth: Floats,
    shapes: Iterable[Floats],
    options: JawTrackOptions = TRACKS,
) -> JawTracks:
    """Return the tracks that a template's expressions move the jaw along.

    ``shapes`` are the motions (n, 3) of points ``teeth`` (n, 3) that ride on the mandible, one an
    expression. The point between the condyles goes a chord of the tracks in each that is rigid.
    Straight tracks have the slope of the widest opening, as a jaw that is pushed forward goes
    flatter, on its teeth; curved ones the slope at rest and the growth that suit all chords best.
    Shapes without such motions give the options' tracks.
    """
    slides = []
    angles = []
    hinges = [0.0]
    for shape in shapes:
        motion = weighted_motion(teeth, teeth + shape, np.ones(len(teeth)))
        size = float(np.linalg.norm(shape, axis=1).max())
        left = np.linalg.norm(motion(teeth) - teeth - shape, axis=1)
        if size < options.least_mm or np.sqrt((left**2).mean()) > options.rigid * size:
            continue
        across, up, ahead = (motion(frame.origin[None])[0] - frame.origin) @ frame.axes.T
        turned = frame.axes @ motion.rotation @ frame.axes.T
        length = float(np.hypot(up, ahead))
        if (
            length >= options.least_slide_mm
            and ahead > 0.0
            and abs(across) < options.sideways * length
        ):
            hinges.append(float(np.arctan2(-turned[1, 2], turned[1, 1])))
            slides.append(length)
            angles.append(float(np.arctan2(-up, ahead)))
    usual = JawTracks(
        frame,
        float(np.radians(options.slope_deg)),
        apart,
        options.length_mm,
        float(np.radians(options.opening_deg)),
        retrusion=options.retrusion_mm,
    )
    if not slides:
        return usual
    s = np.array(slides)
    angle = np.array(angles)
    slope = angles[int(np.argmax(hinges[1:]))]
    bend = 0.0
    if options.curved and np.ptp(s) > options.spread * s.max():
        # a chord's angle is that at half its way; tracks begin level or downwards
        slope, bend = map(float, nnls(np.stack([s, 0.5 * s * s], 1), angle * s)[0])
    length = max(float(s.max()), options.length_mm)
    opening = max(*hinges, usual.opening)
    return replace(usual, slope=slope, bend=bend, length=length, opening=opening)


def nearest_jaw(
    jaw: JawMotion,
    points: Floats,
    goal: Floats,
    start: Floats,
    *,
    inner: Floats | None = None,
    bounds: tuple[Floats | float, Floats | float] = (-np.inf, np.inf),
) -> Floats:
    """Return the numbers (k,) of a jaw that carry ``points`` (n, 3) nearest to a ``goal`` (n, 3).

    Gauss-Newton from ``start`` (k,); ``inner`` (3 n, 3 n) weighs the distances, ``bounds`` are the
    least and the greatest numbers.
    """
    b = start
    for _ in range(NEAREST_STEPS):
        rates = jaw.jacobian(points, b).reshape(3 * len(points), -1)
        weighted = rates.T if inner is None else rates.T @ inner
        away = (jaw.move(points, b) - goal).ravel()
        before = b
        b = np.clip(b - np.linalg.solve(weighted @ rates, weighted @ away), *bounds)
        if np.abs(b - before).max() < NEAREST:
            break
    return b
