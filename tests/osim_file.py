"""An OSIM file of our own for tests: a neck in OpenSim's words, which OpenSim itself reads."""

from __future__ import annotations

import random
import re

import numpy as np

from solver.neck.anatomy import BODIES, Neck
from solver.neck.osim_joints import TO_OURS

AXES = ("0 0 1", "1 0 0", "0 1 0")  # of pitch, roll and yaw in OpenSim: nod, tilt and turn
OURS = (0, 2, 1)  # these axes of ours


def osim_text(neck: Neck) -> str:
    """Return a neck as an OSIM file of OpenSim 4, its coordinates' ranges those of its joints."""
    below = np.vstack([np.zeros(3), neck.centres])
    bodies = [_body("torso", 30.0, np.zeros(3), np.eye(3))]
    joints = []
    discs = []
    joints.append(_joint("WeldJoint", "base", "/ground", "/bodyset/torso", np.zeros(3), ""))
    for k, name in enumerate(BODIES[1:]):
        at = neck.mass_centres[k] - neck.centres[k]
        bodies.append(_body(name, neck.masses[k], at, neck.inertias[k]))
        parent = f"/bodyset/{BODIES[k]}"
        inside = _turns(name, neck.ranges[k])
        step = below[k + 1] - below[k]
        joints.append(_joint("CustomJoint", f"to_{name}", parent, f"/bodyset/{name}", step, inside))
        # stiffness about x, y, z of OpenSim: our z, y, x
        stiff, slow = (_numbers(each[k][[2, 1, 0]]) for each in (neck.stiffness, neck.damping))
        discs.append(
            f'<BushingForce name="{name}_disc"><socket_frame1>{parent}</socket_frame1>\n'
            f"<socket_frame2>/bodyset/{name}</socket_frame2>\n"
            f"<rotational_stiffness>{stiff}</rotational_stiffness>\n"
            f"<rotational_damping>{slow}</rotational_damping></BushingForce>\n"
        )
    muscles = []
    for muscle in neck.muscles:
        points = "".join(
            f'<PathPoint name="p{k}"><socket_parent_frame>/bodyset/{BODIES[body]}'
            f"</socket_parent_frame>\n<location>{_place(point - below[body])}</location>"
            "</PathPoint>\n"
            for k, (body, point) in enumerate(zip(muscle.bodies, muscle.points, strict=True))
        )
        muscles.append(
            f'<Millard2012EquilibriumMuscle name="{muscle.name}"><GeometryPath name="path">\n'
            f"<PathPointSet><objects>{points}</objects></PathPointSet></GeometryPath>\n"
            f"<max_isometric_force>{muscle.strength}</max_isometric_force>\n"
            f"<optimal_fiber_length>{muscle.fibre / 1e3}</optimal_fiber_length>\n"
            f"<tendon_slack_length>{muscle.tendon / 1e3}</tendon_slack_length>\n"
            f"<pennation_angle_at_optimal>{muscle.pennation}</pennation_angle_at_optimal>\n"
            "</Millard2012EquilibriumMuscle>\n"
        )
    return (
        '<?xml version="1.0" encoding="UTF-8" ?>\n<OpenSimDocument Version="40000">\n'
        '<Model name="neck">\n<length_units>meters</length_units>\n'
        f'<BodySet name="bodyset"><objects>\n{"".join(bodies)}</objects></BodySet>\n'
        f'<JointSet name="jointset"><objects>\n{"".join(joints)}</objects></JointSet>\n'
        f'<ForceSet name="forceset"><objects>\n{"".join(discs + muscles)}</objects></ForceSet>\n'
        "</Model>\n</OpenSimDocument>\n"
    )


def mutated(text: str, seed: int) -> str:
    """Return a file with a few things done to it that nobody would."""
    dice = random.Random(seed)
    for _ in range(dice.randint(1, 4)):
        numbers = list(re.finditer(r"(?<=[> ])-?\d[\d.e-]*(?=[< ])", text))
        lines = text.split("\n")
        match dice.randrange(6):
            case 0:
                found = dice.choice(numbers)
                put = dice.choice(["0", "-1", "1e308", "nan", "", "1e-300", "x", "9" * 400])
                text = text[: found.start()] + put + text[found.end() :]
            case 1:
                del lines[dice.randrange(len(lines))]
                text = "\n".join(lines)
            case 2:
                at = dice.randrange(len(lines))
                lines.insert(at, lines[dice.randrange(len(lines))])
                text = "\n".join(lines)
            case 3:
                names = list(re.finditer(r"/bodyset/(\w+)", text))
                found = dice.choice(names)
                put = dice.choice(names).group(0)
                text = text[: found.start()] + put + text[found.end() :]
            case 4:
                tags = re.findall(r"</(\w+)>", text)
                old = dice.choice(tags)
                new = dice.choice(tags)
                text = text.replace(f"<{old}", f"<{new}").replace(f"</{old}>", f"</{new}>")
            case _:
                begin = dice.randrange(len(text))
                text = text[:begin] + text[begin + dice.randrange(60) :]
    return text


def _body(name: str, mass: float, at: np.ndarray, inertia: np.ndarray) -> str:
    turned = TO_OURS.T @ inertia @ TO_OURS
    six = _numbers(turned[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    return (
        f'<Body name="{name}"><mass>{mass}</mass>\n<mass_center>{_place(at)}</mass_center>\n'
        f"<inertia>{six}</inertia></Body>\n"
    )


def _joint(kind: str, name: str, parent: str, child: str, step: np.ndarray, inside: str) -> str:
    frame = '<PhysicalOffsetFrame name="{}"><socket_parent>{}</socket_parent>\n<translation>{}'
    after = "</translation><orientation>0 0 0</orientation></PhysicalOffsetFrame>\n"
    return (
        f'<{kind} name="{name}"><socket_parent_frame>below</socket_parent_frame>\n'
        "<socket_child_frame>above</socket_child_frame>\n<frames>"
        f"{frame.format('below', parent, _place(step))}{after}"
        f"{frame.format('above', child, '0 0 0')}{after}</frames>\n{inside}</{kind}>\n"
    )


def _turns(name: str, ranges: np.ndarray) -> str:
    coordinates = []
    axes = []
    for k, (axis, ours) in enumerate(zip(AXES, OURS, strict=True), 1):
        coordinates.append(
            f'<Coordinate name="{name}_{k}"><default_value>0</default_value>\n'
            f"<range>{-ranges[ours]} {ranges[ours]}</range></Coordinate>\n"
        )
        axes.append(
            f'<TransformAxis name="rotation{k}"><coordinates>{name}_{k}</coordinates>\n'
            f'<axis>{axis}</axis><LinearFunction name="function">'
            "<coefficients>1 0</coefficients></LinearFunction></TransformAxis>\n"
        )
    shifts = [
        f'<TransformAxis name="translation{k}"><coordinates></coordinates>\n<axis>{axis}</axis>'
        '<Constant name="function"><value>0</value></Constant></TransformAxis>\n'
        for k, axis in enumerate(("1 0 0", "0 1 0", "0 0 1"), 1)
    ]
    return (
        f"<coordinates>{''.join(coordinates)}</coordinates>\n"
        f"<SpatialTransform>{''.join(axes + shifts)}</SpatialTransform>\n"
    )


def _place(ours: np.ndarray) -> str:
    return _numbers(TO_OURS.T @ ours / 1e3)


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in values)
