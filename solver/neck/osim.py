"""Necks of OpenSim: an OSIM file as bodies, ball joints, discs and muscles of our own.

OpenSim's axes become ours and its metres mm; the origin is the head's joint, and the skull is
upright where its frame is. Gravity is ours, whatever the file's stance on the ground is.

Ranges of motion, and how much of a rotation each joint takes, come from the coordinates' ranges
through the joints' functions and the couplers. In the simulation all 24 rotations are free.

Sherman, Seth, Delp 2011, and the reference of OpenSim 4 have the format.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from solver.errors import quote, quote_names
from solver.neck.anatomy import JOINTS, Neck, NeckMuscle, ball_inertia
from solver.neck.elements import Element, XmlLimits, read_elements
from solver.neck.osim_joints import Function, M, OsimSkeleton, Placed, read_function
from solver.surface import Floats

MUSCLES = (
    "Millard2012EquilibriumMuscle",
    "Millard2012AccelerationMuscle",
    "Thelen2003Muscle",
    "DeGrooteFregly2016Muscle",
)


@dataclass(frozen=True)
class OsimOptions:
    """How a file is read."""

    keep_inertias: bool = False  # as the file has them, however large
    density: float = 1100.0  # kg/m^3, of the balls whose inertia bodies get
    most_inertia: float = 3.0  # x that of such a ball; a larger one is replaced
    free_range: float = 3.2  # rad; a coordinate that may go farther has no range
    usual_range: float = 0.15  # rad, of a joint's axis whose coordinate has no range
    most_muscles: int = 1000
    least_mass: float = 0.01  # kg, of a vertebra with what is about it, and the head
    most_mass: float = 30.0
    most_mm: float = 2000.0  # from the head's joint to anything
    most_stiffness: float = 1e4  # N m/rad, of a disc, and its damping in N m s/rad
    most_strength: float = 1e4  # N
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


class _Model:
    def __init__(self, model: Element, options: OsimOptions) -> None:
        self.model = model
        self.options = options
        self.notices: list[str] = []
        units = model.word("length_units", "meters")
        if units not in ("meters", "m"):
            raise model.need("length_units").error(f"is '{quote(units)}', not meters")
        for element in model.all():
            if element.tag == "WrapObjectSet" and (inside := element.find("objects")):
                for wrap in inside:
                    raise wrap.error("is a wrap object; muscles go along straight lines here")
        self.skeleton = OsimSkeleton(model)

    def neck(self) -> Neck:
        chain = self.skeleton.chain
        centres = np.array([self.skeleton.ours(each.before, each.parent) for each in chain])
        for joint, centre in zip(chain, centres, strict=True):
            if np.linalg.norm(centre) > self.options.most_mm:
                raise joint.element.error("is far from the head")
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

    # Motion

    def _ranges(self) -> Floats:
        """Return how far each joint turns about our axes (8, 3), to either side."""
        given: dict[str, tuple[float, float]] = {}
        for joint in self.skeleton.joints:
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
        ranges = np.zeros((JOINTS, 3))
        missing = []
        for number, joint in enumerate(self.skeleton.chain):
            for turn in joint.turns:
                if not turn.coordinate:
                    continue
                axis = np.abs(self.skeleton.axes(joint.parent) @ joint.before.R @ turn.axis)
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
        return read_function(holder.children[0])

    def _discs(self) -> tuple[Floats, Floats]:
        """Return stiffness and damping of the discs, (8, 3) each, of the file's bushings."""
        found = np.zeros((2, JOINTS, 3))
        for force in self.model.find("ForceSet/objects") or ():
            if force.tag != "BushingForce" or force.word("appliesForce") == "false":
                continue
            bodies = [self.skeleton.named_body(force, f"socket_frame{end}") for end in (1, 2)]
            numbers = sorted(self.skeleton.numbers[body] for body in bodies)
            if numbers[1] != numbers[0] + 1:
                raise force.error("is not between two bodies that follow each other")
            R = self.skeleton.axes(bodies[0])
            for row, name in enumerate(("rotational_stiffness", "rotational_damping")):
                values = force.numbers(name, 3, np.zeros(3))
                if (values < 0.0).any() or (values > self.options.most_stiffness).any():
                    words = f"is not within 0 and {self.options.most_stiffness:g}"
                    raise force.need(name).error(words)
                found[row, numbers[0]] += np.diag(R @ np.diag(values) @ R.T)
        if not found[0].any():
            self.notices.append("no discs (BushingForce) were found: joints are without stiffness")
        return found[0], found[1]

    # Bodies

    def _masses(self) -> tuple[Floats, Floats, Floats]:
        """Return masses (8,), mass centres (8, 3) in mm and inertias (8, 3, 3) about them."""
        parts: list[list[tuple[float, Floats, Floats]]] = [[] for _ in range(JOINTS)]
        for name, body in self.skeleton.bodies.items():
            mass = body.number("mass")
            if mass < 0.0:
                raise body.need("mass").error("is negative")
            number = self.skeleton.numbers[name] - 1
            if number < 0 or mass == 0.0:
                continue
            centre = Placed(np.eye(3), body.numbers("mass_center", 3, np.zeros(3)))
            xx, yy, zz, xy, xz, yz = body.numbers("inertia", 6, np.zeros(6))
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            R = self.skeleton.axes(name)
            parts[number].append((mass, self.skeleton.ours(centre, name), R @ inertia @ R.T))
        masses = np.zeros(JOINTS)
        centres = np.zeros((JOINTS, 3))
        inertias = []
        replaced = []
        worst = 0.0
        for number, inside in enumerate(parts):
            if not inside:
                raise self.skeleton.chain[number].element.error("carries a body without mass")
            masses[number] = sum(mass for mass, _, _ in inside)
            if not self.options.least_mass <= masses[number] <= self.options.most_mass:
                words = f"carries {masses[number]:g} kg, which is no part of a neck or a head"
                raise self.skeleton.chain[number].element.error(words)
            centres[number] = sum(mass * at for mass, at, _ in inside) / masses[number]
            inertia = np.zeros((3, 3))
            for mass, at, own in inside:
                d = (at - centres[number]) / M
                inertia += own + mass * (d @ d * np.eye(3) - np.outer(d, d))
            ball = ball_inertia(masses[number], self.options.density)
            least, most = np.linalg.eigvalsh(inertia)[[0, -1]]
            if not self.options.keep_inertias and (
                most > self.options.most_inertia * ball or least <= 0.0
            ):
                replaced.append(self.skeleton.chain[number].child)
                worst = max(worst, most / ball)
                inertia = ball * np.eye(3)
            inertias.append(inertia)
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
                body, at = self.skeleton.point(marker, "socket_parent_frame")
                if body == JOINTS:
                    found[marker.name] = at
        return found

    # Muscles

    def _muscles(self) -> tuple[NeckMuscle, ...]:
        found: list[NeckMuscle] = []
        skipped = []
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

    def _muscle(self, force: Element, path: Element) -> NeckMuscle:
        wraps = path.find("PathWrapSet/objects")
        for wrap in wraps or ():
            raise wrap.error(f"of '{quote(force.name)}' is wrapping, which is not read")
        bodies = []
        points = []
        for point in path.need("PathPointSet/objects"):
            if point.tag != "PathPoint":
                raise point.error(f"of '{quote(force.name)}' moves; only PathPoint is read")
            body, at = self.skeleton.point(point, "socket_parent_frame")
            if np.linalg.norm(at) > self.options.most_mm:
                raise point.error(f"of '{quote(force.name)}' is far from the head")
            bodies.append(body)
            points.append(at)
        if len(points) < 2:
            raise path.error(f"of '{quote(force.name)}' has fewer than two points")
        numbers = {}
        for name in ("max_isometric_force", "optimal_fiber_length", "tendon_slack_length"):
            numbers[name] = force.number(name)
            if numbers[name] < 0.0 or (numbers[name] == 0.0 and name != "tendon_slack_length"):
                raise force.need(name).error("is not positive")
        if numbers["max_isometric_force"] > self.options.most_strength:
            raise force.need("max_isometric_force").error("is more than a muscle of the neck has")
        pennation = force.number("pennation_angle_at_optimal", 0.0)
        if not 0.0 <= pennation < 1.4:
            raise force.need("pennation_angle_at_optimal").error("is not within 0 and 1.4")
        muscle = NeckMuscle(
            force.name,
            np.array(bodies),
            np.array(points),
            numbers["max_isometric_force"],
            numbers["optimal_fiber_length"] * M,
            numbers["tendon_slack_length"] * M,
            pennation,
            self.model.file,
        )
        if not re.fullmatch(r"[ -~]{1,200}", muscle.name) or muscle.length < 1e-3:
            raise force.error("has no name in plain letters, or no length")
        return muscle
