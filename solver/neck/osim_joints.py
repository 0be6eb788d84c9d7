"""Bodies and joints of an OSIM file of OpenSim 4, and the chain of joints that carries the head.

The chain is climbed from the skull; its first eight joints that turn are the head's and those of
C1 ... C7. What is under them is the torso. Bodies that are welded to one of these, or that hang on
it by a joint of their own, are part of it. All is seen with every coordinate at 0. OpenSim's axes
are x forward, y up, z to the right, its lengths m.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from solver.errors import quote, quote_names
from solver.neck.anatomy import JOINTS
from solver.neck.elements import Element
from solver.surface import Floats

HEADS = ("skull", "head", "cranium", "head_neck")
TO_OURS = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # rotation, of directions
M = 1000.0  # mm
TURNING = ("CustomJoint", "PinJoint", "BallJoint")
Function = Callable[[float], float]


@dataclass(frozen=True)
class Placed:
    """A rigid motion in OpenSim's axes, in m: x -> R x + t."""

    R: Floats
    t: Floats

    def then(self, inner: Placed) -> Placed:
        """Return this motion of what ``inner`` places."""
        return Placed(self.R @ inner.R, self.R @ inner.t + self.t)

    def inverse(self) -> Placed:
        """Return the motion back."""
        return Placed(self.R.T, -self.R.T @ self.t)


STILL = Placed(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Turn:
    """One rotation of a joint: by ``angle(value of coordinate)`` about an axis of its frame."""

    axis: Floats
    coordinate: str  # none where the angle is fixed
    angle: Function


@dataclass(frozen=True)
class OsimJoint:
    """A joint: it turns the body ``child`` against ``parent``, or welds it to it."""

    element: Element
    parent: str
    child: str
    before: Placed  # the joint's frame in the parent body
    after: Placed  # the joint's frame in the child body
    turns: tuple[Turn, ...]

    @property
    def placed(self) -> Placed:
        """The child body in its parent's frame, all coordinates at 0."""
        R = np.eye(3)
        for turn in self.turns:
            R = R @ Rotation.from_rotvec(turn.axis * turn.angle(0.0)).as_matrix()
        return self.before.then(Placed(R, np.zeros(3))).then(self.after.inverse())


class OsimSkeleton:
    """The bodies and joints of a model.

    Raises ``neck.osim`` for what cannot be read.
    """

    def __init__(self, model: Element) -> None:
        self.model = model
        self.bodies = {each.name: each for each in model.need("BodySet/objects")}
        self.frames: dict[str, str] = {}  # the body of an offset frame, by joint/frame
        self.joints = [self._joint(each) for each in model.need("JointSet/objects")]
        self._placed: dict[str, Placed] = {}  # bodies in the ground's frame, as they are asked for
        self.joint_of: dict[str, OsimJoint] = {}
        for joint in self.joints:
            if joint.child in self.joint_of:
                raise joint.element.error(f"is a second joint under '{quote(joint.child)}'")
            self.joint_of[joint.child] = joint

    def _joint(self, element: Element) -> OsimJoint:
        if element.tag not in (*TURNING, "WeldJoint"):
            raise element.error("is a joint of another kind than custom, pin, ball and weld")
        frames = {}
        for frame in element.find("frames") or ():
            body = self.named_body(frame, "socket_parent")
            angles = frame.numbers("orientation", 3, np.zeros(3))
            R = Rotation.from_euler("XYZ", angles).as_matrix()
            self.frames[f"{element.name}/{frame.name}"] = body
            frames[frame.name] = body, Placed(R, frame.numbers("translation", 3, np.zeros(3)))
        ends = []
        for socket in ("socket_parent_frame", "socket_child_frame"):
            name = element.need(socket).text.strip()
            if name.rsplit("/", 1)[-1] in frames:
                ends.append(frames[name.rsplit("/", 1)[-1]])
            else:
                ends.append((self.named_body(element, socket), STILL))
        (parent, before), (child, after) = ends
        return OsimJoint(element, parent, child, before, after, self._turns(element))

    def named_body(self, element: Element, socket: str) -> str:
        """Return the body that a socket names; raises ``neck.osim`` if it is missing."""
        found = element.need(socket)
        words = found.text.strip().split("/")
        name = self.frames.get("/".join(words[-2:]), words[-1])
        for frame in element.find("frames") or ():
            if frame.name == name and socket != "socket_parent":
                return self.named_body(frame, "socket_parent")
        if name != "ground" and name not in self.bodies:
            raise found.error(f"names the body '{quote(name)}', which is missing")
        return name

    def _turns(self, element: Element) -> tuple[Turn, ...]:
        names = [each.name for each in element.find("coordinates") or ()]
        if element.tag == "WeldJoint":
            return ()
        if element.tag != "CustomJoint":
            axes = np.eye(3)[[2]] if element.tag == "PinJoint" else np.eye(3)
            if len(names) != len(axes):
                raise element.error(f"has {len(names)} coordinates, not {len(axes)}")
            pairs = zip(axes, names, strict=True)
            return tuple(Turn(axis, name, lambda value: value) for axis, name in pairs)
        turns = []
        for axis in element.need("SpatialTransform"):
            if axis.tag != "TransformAxis":
                continue
            coordinate = axis.word("coordinates")
            angle = function_in(axis)
            if axis.name.startswith("rotation"):
                direction = axis.numbers("axis", 3)
                length = float(np.linalg.norm(direction))
                if length < 1e-9:
                    raise axis.need("axis").error("has no direction")
                if coordinate and coordinate not in names:
                    raise axis.error(f"turns by '{quote(coordinate)}', which the joint lacks")
                turns.append(Turn(direction / length, coordinate, angle))
            elif self._is_of_neck(element) and any(abs(angle(x)) > 1e-6 for x in (-0.5, 0, 0.5)):
                raise axis.error("shifts the joint; joints turn about fixed points here")
        return tuple(turns)

    def _is_of_neck(self, element: Element) -> bool:
        """Tell joints that hang on the ground, which may do as they like, from others."""
        parent = element.need("socket_parent_frame").text.strip().rsplit("/", 1)[-1]
        frames = element.find("frames") or ()
        bodies = [each.word("socket_parent") for each in frames if each.name == parent]
        return not any(each.rsplit("/", 1)[-1] == "ground" for each in [parent, *bodies])

    @cached_property
    def chain(self) -> list[OsimJoint]:
        """The eight joints that turn, from the torso to the head."""
        heads = [name for name in self.bodies if name.lower() in HEADS]
        if not heads:
            known = ", ".join(quote_names([*self.bodies]))
            raise self.model.need("BodySet").error(f"has no skull or head, but {known}")
        found: list[OsimJoint] = []
        body = heads[0]
        seen = set()
        while len(found) < JOINTS:
            joint = self.joint_of.get(body)
            if joint is None or joint.parent == "ground" or body in seen:
                words = f"reaches the head by {len(found)} joints that turn, not by {JOINTS}"
                raise self.model.need("JointSet").error(words)
            seen.add(body)
            if any(turn.coordinate for turn in joint.turns):
                found.append(joint)
            body = joint.parent
        return found[::-1]

    @cached_property
    def numbers(self) -> dict[str, int]:
        """Each body's number in BODIES, of which it is, or is a part; those below are the torso."""
        numbers = {"ground": 0}
        numbers |= {joint.child: number for number, joint in enumerate(self.chain, 1)}
        for name in self.bodies:
            under = self._joints_under(name, numbers)
            found = numbers.get(under[-1].parent if under else name, 0)
            numbers |= dict.fromkeys([name, *(joint.parent for joint in under)], found)
        return numbers

    def _in_torso(self, body: str) -> Placed:
        """Return where a body is, in the frame of the body under the lowest joint."""
        torso = self.chain[0].parent
        return self._in_ground(torso).inverse().then(self._in_ground(body))

    def _in_ground(self, body: str) -> Placed:
        for joint in reversed(self._joints_under(body, self._placed)):
            self._placed[joint.child] = self._placed.get(joint.parent, STILL).then(joint.placed)
        return self._placed.get(body, STILL)

    def _joints_under(self, body: str, known: Container[str]) -> list[OsimJoint]:
        """Return the joints from a body down to the first one that is ``known``, or the last."""
        found: list[OsimJoint] = []
        while body not in known and (joint := self.joint_of.get(body)) is not None:
            found.append(joint)
            body = joint.parent
            if len(found) > len(self.bodies):
                raise joint.element.error("is part of a circle of joints")
        return found

    @cached_property
    def _to_head(self) -> Placed:
        """From the torso's frame to one with the skull's axes and the head's joint as origin."""
        head = self.chain[-1]
        joint = self._in_torso(head.parent).then(head.before)
        return Placed(self._in_torso(head.child).R, joint.t).inverse()

    def ours(self, placed: Placed, body: str) -> Floats:
        """Return the place of a frame of a body, (3,) mm in our axes."""
        return np.asarray(TO_OURS @ self._to_head.then(self._in_torso(body)).then(placed).t * M)

    def axes(self, body: str) -> Floats:
        """Return the rotation from a body's frame to our axes (3, 3)."""
        return np.asarray(TO_OURS @ self._to_head.R @ self._in_torso(body).R)

    def point(self, element: Element, socket: str) -> tuple[int, Floats]:
        """Return the body of an element with a ``location``, by its number, and the place in mm."""
        body = self.named_body(element, socket)
        at = Placed(np.eye(3), element.numbers("location", 3))
        return self.numbers[body], self.ours(at, body)


def function_in(holder: Element) -> Function:
    """Return the function that an element holds, beside others; 0 without one."""
    for each in holder:
        inside = each.children[0] if each.tag == "function" and each.children else each
        if inside.tag not in ("coordinates", "axis", "scale"):
            return read_function(inside)
    return lambda _: 0.0


def read_function(element: Element) -> Function:
    """Return a function of one number; raises ``neck.osim`` for a kind that is not read."""
    if element.tag == "Constant":
        value = element.number("value", 0.0)
        return lambda _: value
    if element.tag in ("LinearFunction", "PolynomialFunction"):
        powers = element.numbers("coefficients", None)
        return lambda x: float(np.polyval(powers, x))
    if element.tag == "MultiplierFunction":
        inner = function_in(element)
        scale = element.number("scale", 1.0)
        return lambda x: scale * inner(x)
    if element.tag in ("SimmSpline", "NaturalCubicSpline", "PiecewiseLinearFunction"):
        x = element.numbers("x", None)
        y = element.numbers("y", None)
        if len(x) != len(y) or len(x) < 2 or (np.diff(x) <= 0.0).any():
            raise element.error("is no table of at least two places in rising order")
        if len(x) == 2 or element.tag == "PiecewiseLinearFunction":
            slopes = np.diff(y) / np.diff(x)
            last = len(slopes) - 1
            return lambda at: float(
                y[k := int(np.clip(np.searchsorted(x, at) - 1, 0, last))] + slopes[k] * (at - x[k])
            )
        spline = CubicSpline(x, y, bc_type="natural")
        return lambda at: float(spline(at))
    raise element.error("is a function that is not read")
