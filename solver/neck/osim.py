"""Necks of OpenSim: an OSIM file as bodies, ball joints, discs and muscles of our own.

The chain of joints is climbed from the skull; the first eight that turn are the head's and those of
C1 ... C7, and what is under them is the torso, which stands still. Bodies that are welded to one of
them, or that hang on it by a joint of their own, are part of it. OpenSim's axes (x forward, y up,
z to the right) become ours, its metres mm, and all is seen with every coordinate at 0.

Ranges of motion, and how much of a rotation each joint takes, come from the coordinates' ranges
through the joints' functions and the couplers. In the simulation all 24 rotations are free.

Sherman, Seth, Delp 2011, and the reference of OpenSim 4 have the format.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from solver.errors import quote, quote_names
from solver.neck.anatomy import JOINTS, Muscle, Neck
from solver.neck.elements import Element, XmlLimits, read_elements
from solver.surface import Floats

HEADS = ("skull", "head", "cranium", "head_neck")
TO_OURS = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # rotation, of directions
MM = 1000.0
TURNING = ("CustomJoint", "PinJoint", "BallJoint")
MUSCLES = (
    "Millard2012EquilibriumMuscle",
    "Millard2012AccelerationMuscle",
    "Thelen2003Muscle",
    "DeGrooteFregly2016Muscle",
)
Function = Callable[[float], float]


@dataclass(frozen=True)
class OsimOptions:
    """How a file is read."""

    keep_inertias: bool = False  # as the file has them, however large
    density: float = 1100.0  # kg/m^3, of the balls whose inertia bodies get
    most_inertia: float = 3.0  # x that of such a ball; a larger one is replaced
    free_range: float = 3.2  # rad; a coordinate that may go farther has no range
    usual_range: float = 0.15  # rad, of a joint's axis whose coordinate has no range
    most_muscles: int = 1000
    limits: XmlLimits = field(default_factory=XmlLimits)


def read_osim(path: Path, options: OsimOptions = OsimOptions()) -> Neck:
    """Return the neck of an OSIM file of OpenSim 4.

    Raises ``neck.osim`` with the file, the line and the element for what is not read: wrapping,
    points that move, joints other than custom, pin, ball and weld, joints that shift, bodies that
    are missing, other roots, and files that are too large.
    """
    root = read_elements(path, options.limits)
    if root.tag != "OpenSimDocument":
        raise root.error("is the root, not OpenSimDocument")
    return _Model(root.need("Model"), options).neck()


@dataclass(frozen=True)
class _Placed:
    """A rigid motion in OpenSim's axes, in m: x -> R x + t."""

    R: Floats
    t: Floats

    def then(self, inner: _Placed) -> _Placed:
        """Return this motion of what ``inner`` places."""
        return _Placed(self.R @ inner.R, self.R @ inner.t + self.t)

    def inverse(self) -> _Placed:
        return _Placed(self.R.T, -self.R.T @ self.t)


@dataclass(frozen=True)
class _Turn:
    """One rotation of a joint: by ``angle(value of coordinate)`` about an axis of its frame."""

    axis: Floats
    coordinate: str
    angle: Function


@dataclass(frozen=True)
class _Joint:
    element: Element
    parent: str
    child: str
    before: _Placed  # the joint's frame in the parent body
    after: _Placed  # the joint's frame in the child body
    turns: tuple[_Turn, ...]

    @property
    def placed(self) -> _Placed:
        """The child body in its parent's frame, all coordinates at 0."""
        R = np.eye(3)
        for turn in self.turns:
            R = R @ Rotation.from_rotvec(turn.axis * turn.angle(0.0)).as_matrix()
        return self.before.then(_Placed(R, np.zeros(3))).then(self.after.inverse())


class _Model:
    def __init__(self, model: Element, options: OsimOptions) -> None:
        self.model, self.options = model, options
        self.notices: list[str] = []
        units = model.word("length_units", "meters")
        if units not in ("meters", "m"):
            raise model.need("length_units").error(f"is '{quote(units)}', not meters")
        for element in model.all():
            if element.tag == "WrapObjectSet" and (inside := element.find("objects")):
                for wrap in inside:
                    raise wrap.error("is a wrap object; muscles go along straight lines here")
        self.bodies = {each.name: each for each in model.need("BodySet/objects")}
        self.joints = [self._joint(each) for each in model.need("JointSet/objects")]
        self.joint_of: dict[str, _Joint] = {}
        for joint in self.joints:
            if joint.child in self.joint_of:
                raise joint.element.error(f"is a second joint under '{quote(joint.child)}'")
            self.joint_of[joint.child] = joint

    def neck(self) -> Neck:
        chain = self.chain
        centres = np.array([self._ours(each.before, each.parent) for each in chain])
        ranges = self._ranges()
        stiffness, damping = self._discs()
        masses, mass_centres, inertias = self._masses()
        muscles = self._muscles()
        sums = ranges.sum(axis=0)
        return Neck(
            centres,
            masses,
            mass_centres,
            inertias,
            stiffness,
            damping,
            ranges,
            np.where(sums > 0.0, ranges / np.maximum(sums, 1e-12), 1.0 / JOINTS),
            muscles,
            self.model.file,
            self._landmarks(),
            tuple(self.notices),
        )

    # Frames and joints

    def _joint(self, element: Element) -> _Joint:
        if element.tag not in (*TURNING, "WeldJoint"):
            raise element.error("is a joint of another kind than custom, pin, ball and weld")
        frames = {}
        for frame in element.find("frames") or ():
            body = self._named_body(frame, "socket_parent")
            angles = frame.numbers("orientation", 3, np.zeros(3))
            R = Rotation.from_euler("XYZ", angles).as_matrix()
            frames[frame.name] = body, _Placed(R, frame.numbers("translation", 3, np.zeros(3)))
        ends = []
        for socket in ("socket_parent_frame", "socket_child_frame"):
            name = element.need(socket).text.strip()
            if name.rsplit("/", 1)[-1] in frames:
                ends.append(frames[name.rsplit("/", 1)[-1]])
            else:
                none = _Placed(np.eye(3), np.zeros(3))
                ends.append((self._named_body(element, socket), none))
        (parent, before), (child, after) = ends
        return _Joint(element, parent, child, before, after, self._turns(element))

    def _named_body(self, element: Element, socket: str) -> str:
        found = element.need(socket)
        name = found.text.strip().rsplit("/", 1)[-1]
        if name != "ground" and name not in self.bodies:
            raise found.error(f"names the body '{quote(name)}', which is missing")
        return name

    def _turns(self, element: Element) -> tuple[_Turn, ...]:
        names = [each.name for each in element.find("coordinates") or ()]
        if element.tag == "WeldJoint":
            return ()
        if element.tag != "CustomJoint":
            axes = np.eye(3)[[2]] if element.tag == "PinJoint" else np.eye(3)
            if len(names) != len(axes):
                raise element.error(f"has {len(names)} coordinates, not {len(axes)}")
            pairs = zip(axes, names, strict=True)
            return tuple(_Turn(axis, name, lambda value: value) for axis, name in pairs)
        turns = []
        for axis in element.need("SpatialTransform"):
            if axis.tag != "TransformAxis":
                continue
            coordinate = axis.word("coordinates")
            angle = self._function_in(axis)
            if axis.name.startswith("rotation"):
                direction = axis.numbers("axis", 3)
                length = float(np.linalg.norm(direction))
                if length < 1e-9:
                    raise axis.need("axis").error("has no direction")
                if coordinate and coordinate not in names:
                    raise axis.error(f"turns by '{quote(coordinate)}', which the joint lacks")
                turns.append(_Turn(direction / length, coordinate, angle))
            elif self._is_of_neck(element) and any(abs(angle(x)) > 1e-6 for x in (-0.5, 0, 0.5)):
                raise axis.error("shifts the joint; joints turn about fixed points here")
        return tuple(turns)

    def _is_of_neck(self, element: Element) -> bool:
        """Tell joints that hang on the ground, which may do as they like, from others."""
        parent = element.need("socket_parent_frame").text.strip().rsplit("/", 1)[-1]
        frames = element.find("frames") or ()
        bodies = [each.word("socket_parent") for each in frames if each.name == parent]
        return not any(each.rsplit("/", 1)[-1] == "ground" for each in [parent, *bodies])

    def _function_in(self, holder: Element) -> Function:
        for each in holder:
            inside = each.children[0] if each.tag == "function" and each.children else each
            if inside.tag not in ("coordinates", "axis", "scale"):
                return self._function(inside)
        return lambda _: 0.0

    def _function(self, element: Element) -> Function:
        if element.tag == "Constant":
            value = element.number("value", 0.0)
            return lambda _: value
        if element.tag in ("LinearFunction", "PolynomialFunction"):
            powers = element.numbers("coefficients", None)
            return lambda x: float(np.polyval(powers, x))
        if element.tag == "MultiplierFunction":
            inner, scale = self._function_in(element), element.number("scale", 1.0)
            return lambda x: scale * inner(x)
        if element.tag in ("SimmSpline", "NaturalCubicSpline", "PiecewiseLinearFunction"):
            x, y = element.numbers("x", None), element.numbers("y", None)
            if len(x) != len(y) or len(x) < 2 or (np.diff(x) <= 0.0).any():
                raise element.error("is no table of at least two places in rising order")
            if len(x) == 2 or element.tag == "PiecewiseLinearFunction":
                slopes = np.diff(y) / np.diff(x)
                last = len(slopes) - 1
                return lambda at: float(
                    y[k := int(np.clip(np.searchsorted(x, at) - 1, 0, last))]
                    + slopes[k] * (at - x[k])
                )
            spline = CubicSpline(x, y, bc_type="natural")
            return lambda at: float(spline(at))
        raise element.error("is a function that is not read")

    @cached_property
    def chain(self) -> list[_Joint]:
        """The eight joints that turn, from the torso to the head."""
        heads = [name for name in self.bodies if name.lower() in HEADS]
        if not heads:
            known = ", ".join(quote_names([*self.bodies]))
            raise self.model.need("BodySet").error(f"has no skull or head, but {known}")
        found: list[_Joint] = []
        body, seen = heads[0], set()
        while len(found) < JOINTS:
            joint = self.joint_of.get(body)
            if joint is None or joint.parent == "ground" or body in seen:
                words = f"reaches the head by {len(found)} joints that turn, not by {JOINTS}"
                raise self.model.need("JointSet").error(words)
            seen.add(body)
            if joint.turns:
                found.append(joint)
            body = joint.parent
        return found[::-1]

    @cached_property
    def numbers(self) -> dict[str, int]:
        """Each body's number in BODIES, of which it is, or is a part; those below are the torso."""
        tops = {joint.child: number for number, joint in enumerate(self.chain, 1)}
        numbers = {"ground": 0}
        for name in self.bodies:
            at, steps = name, 0
            while at not in tops and at in self.joint_of and steps <= len(self.bodies):
                at, steps = self.joint_of[at].parent, steps + 1
            numbers[name] = tops.get(at, 0)
        return numbers

    def _in_torso(self, body: str) -> _Placed:
        """Return where a body is, in the frame of the body under the lowest joint."""
        torso = self.chain[0].parent
        return self._in_ground(torso).inverse().then(self._in_ground(body))

    def _in_ground(self, body: str) -> _Placed:
        placed, steps = _Placed(np.eye(3), np.zeros(3)), 0
        while (joint := self.joint_of.get(body)) is not None:
            placed, body, steps = joint.placed.then(placed), joint.parent, steps + 1
            if steps > len(self.bodies):
                raise joint.element.error("is part of a circle of joints")
        return placed

    @cached_property
    def _to_head(self) -> _Placed:
        """From the torso's frame to one with the skull's axes and the head's joint as origin."""
        head = self.chain[-1]
        joint = self._in_torso(head.parent).then(head.before)
        return _Placed(self._in_torso(head.child).R, joint.t).inverse()

    def _ours(self, placed: _Placed, body: str) -> Floats:
        """Return the place of a frame of a body, (3,) mm in our axes."""
        return np.asarray(TO_OURS @ self._to_head.then(self._in_torso(body)).then(placed).t * MM)

    def _axes(self, body: str) -> Floats:
        """Return the rotation from a body's frame to our axes (3, 3)."""
        return np.asarray(TO_OURS @ self._to_head.R @ self._in_torso(body).R)

    def _point(self, element: Element, socket: str) -> tuple[int, Floats]:
        body = self._named_body(element, socket)
        at = _Placed(np.eye(3), element.numbers("location", 3))
        return self.numbers[body], self._ours(at, body)

    # Motion

    def _ranges(self) -> Floats:
        """Return how far each joint turns about our axes (8, 3), to either side."""
        given: dict[str, tuple[float, float]] = {}
        for joint in self.joints:
            for each in joint.element.find("coordinates") or ():
                low, high = each.numbers("range", 2)
                if -self.options.free_range <= low < high <= self.options.free_range:
                    given[each.name] = float(low), float(high)
        coupled = {}
        for each in self.model.find("ConstraintSet/objects") or ():
            if each.tag != "CoordinateCouplerConstraint" or each.word("isEnforced") == "false":
                self.notices.append(f"{each.tag} '{quote(each.name)}' was not read")
                continue
            by = self._function_in_coupler(each)
            coupled[each.word("dependent_coordinate_name")] = (
                each.word("independent_coordinate_names"),
                by,
            )
        ranges, missing = np.zeros((JOINTS, 3)), []
        for number, joint in enumerate(self.chain):
            for turn in joint.turns:
                axis = np.abs(self._axes(joint.parent) @ joint.before.R @ turn.axis)
                name, by = coupled.get(turn.coordinate, (turn.coordinate, lambda value: value))
                ends = given.get(name)
                if ends is None:
                    missing.append(turn.coordinate)
                    ranges[number] += axis * self.options.usual_range
                else:
                    low, high = (turn.angle(by(end)) for end in ends)
                    ranges[number] += axis * abs(high - low) / 2.0
        if missing:
            names = ", ".join(quote_names(missing))
            self.notices.append(f"coordinates without a range got a usual one: {names}")
        return ranges

    def _function_in_coupler(self, element: Element) -> Function:
        holder = element.need("coupled_coordinates_function")
        if not holder.children:
            raise holder.error("has no function")
        return self._function(holder.children[0])

    def _discs(self) -> tuple[Floats, Floats]:
        """Return stiffness and damping of the discs, (8, 3) each, of the file's bushings."""
        found = np.zeros((2, JOINTS, 3))
        for force in self.model.find("ForceSet/objects") or ():
            if force.tag != "BushingForce" or force.word("appliesForce") == "false":
                continue
            bodies = [self._named_body(force, f"socket_frame{end}") for end in (1, 2)]
            numbers = sorted(self.numbers[body] for body in bodies)
            if numbers[1] != numbers[0] + 1:
                raise force.error("is not between two bodies that follow each other")
            R = self._axes(bodies[0])
            for row, name in enumerate(("rotational_stiffness", "rotational_damping")):
                values = force.numbers(name, 3, np.zeros(3))
                if (values < 0.0).any():
                    raise force.need(name).error("is negative")
                found[row, numbers[0]] += np.diag(R @ np.diag(values) @ R.T)
        if not found[0].any():
            self.notices.append("no discs (BushingForce) were found: joints are without stiffness")
        return found[0], found[1]

    # Bodies

    def _masses(self) -> tuple[Floats, Floats, Floats]:
        """Return masses (8,), mass centres (8, 3) in mm and inertias (8, 3, 3) about them."""
        parts: list[list[tuple[float, Floats, Floats]]] = [[] for _ in range(JOINTS)]
        for name, body in self.bodies.items():
            mass = body.number("mass")
            if mass < 0.0:
                raise body.need("mass").error("is negative")
            number = self.numbers[name] - 1
            if number < 0 or mass == 0.0:
                continue
            at = self._ours(_Placed(np.eye(3), body.numbers("mass_center", 3, np.zeros(3))), name)
            xx, yy, zz, xy, xz, yz = body.numbers("inertia", 6, np.zeros(6))
            I = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            R = self._axes(name)
            parts[number].append((mass, at, R @ I @ R.T))
        masses, centres, inertias = np.zeros(JOINTS), np.zeros((JOINTS, 3)), []
        replaced, worst = [], 0.0
        for number, inside in enumerate(parts):
            if not inside:
                raise self.chain[number].element.error("carries a body without mass")
            masses[number] = sum(mass for mass, _, _ in inside)
            centres[number] = sum(mass * at for mass, at, _ in inside) / masses[number]
            I = np.zeros((3, 3))
            for mass, at, own in inside:
                d = (at - centres[number]) / MM
                I += own + mass * (d @ d * np.eye(3) - np.outer(d, d))
            ball = ball_inertia(masses[number], self.options.density)
            least, most = np.linalg.eigvalsh(I)[[0, -1]]
            if not self.options.keep_inertias and (
                most > self.options.most_inertia * ball or least <= 0.0
            ):
                replaced.append(self.chain[number].child)
                worst = max(worst, most / ball)
                I = ball * np.eye(3)
            inertias.append(I)
        if replaced:
            names = ", ".join(quote_names(replaced))
            words = f"inertias up to {worst:.0f} times those of balls of the same mass were"
            self.notices.append(f"{words} replaced by these: {names}")
        return masses, centres, np.array(inertias)

    def _landmarks(self) -> dict[str, Floats]:
        """Return the file's markers on the skull."""
        found = {}
        for marker in self.model.find("MarkerSet/objects") or ():
            if marker.find("socket_parent_frame") is not None:
                body, at = self._point(marker, "socket_parent_frame")
                if body == JOINTS:
                    found[marker.name] = at
        return found

    # Muscles

    def _muscles(self) -> tuple[Muscle, ...]:
        found, skipped = [], []
        for force in self.model.find("ForceSet/objects") or ():
            path = force.find("GeometryPath") or force.find("path/GeometryPath")
            if path is None:
                continue
            if force.tag not in MUSCLES:
                skipped.append(force.name)
                continue
            muscle = self._muscle(force, path)
            if force.word("appliesForce") == "false" or len(set(muscle.bodies.tolist())) < 2:
                skipped.append(force.name)
                continue
            if len(found) == self.options.most_muscles:
                raise force.error(f"is one more than the {len(found)} muscles that are read")
            found.append(muscle)
        if skipped:
            names = ", ".join(quote_names(skipped))
            self.notices.append(f"muscles that move nothing, or are of no known kind: {names}")
        if not found:
            raise self.model.error("has no muscles")
        return tuple(found)

    def _muscle(self, force: Element, path: Element) -> Muscle:
        wraps = path.find("PathWrapSet/objects")
        for wrap in wraps or ():
            raise wrap.error(f"of '{quote(force.name)}' is wrapping, which is not read")
        bodies, points = [], []
        for point in path.need("PathPointSet/objects"):
            if point.tag != "PathPoint":
                raise point.error(f"of '{quote(force.name)}' moves; only PathPoint is read")
            body, at = self._point(point, "socket_parent_frame")
            bodies.append(body)
            points.append(at)
        if len(points) < 2:
            raise path.error(f"of '{quote(force.name)}' has fewer than two points")
        numbers = {}
        for name in ("max_isometric_force", "optimal_fiber_length", "tendon_slack_length"):
            numbers[name] = force.number(name)
            if numbers[name] < 0.0 or (numbers[name] == 0.0 and name != "tendon_slack_length"):
                raise force.need(name).error("is not positive")
        pennation = force.number("pennation_angle_at_optimal", 0.0)
        if not 0.0 <= pennation < 1.4:
            raise force.need("pennation_angle_at_optimal").error("is not within 0 and 1.4")
        muscle = Muscle(
            force.name,
            np.array(bodies),
            np.array(points),
            numbers["max_isometric_force"],
            numbers["optimal_fiber_length"] * MM,
            numbers["tendon_slack_length"] * MM,
            pennation,
            self.model.file,
        )
        if not re.fullmatch(r"[ -~]{1,200}", muscle.name) or muscle.length < 1e-3:
            raise force.error("has no name in plain letters, or no length")
        return muscle


def ball_inertia(mass: float, density: float) -> float:
    """Return the moment of inertia of a ball, kg m^2, of ``mass`` kg and ``density`` kg/m^3."""
    radius = (3.0 * mass / (4.0 * np.pi * density)) ** (1.0 / 3.0)
    return float(0.4 * mass * radius**2)
