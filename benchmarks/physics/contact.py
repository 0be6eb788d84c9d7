"""Show 2: a face that meets itself, its teeth and objects, with contact and without.

Five scenes, each played frame by frame quasi-statically. ``penetration_max_mm`` is the deepest
that skin lies in skin, in teeth or in an object in any frame, ``lips_mm``, ``teeth_mm`` and
``objects_mm`` of each sort; ``pressed_mm`` how far an object goes on after it would touch;
``behind_teeth`` the most vertices of lips behind teeth, ``frame_s`` the median of a frame,
``inverted`` the most inverted tets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh

from benchmarks.documents import Figures
from benchmarks.physics.fitted import Fitted
from benchmarks.physics.headset import headset
from solver.contact import Gauge, Penetration, contact_potentials
from solver.contact.crossing import depth_inside
from solver.drawing.head import SIDE, THREE_QUARTER, DrawnHead
from solver.drawing.render import Camera, DrawnBody, Lit, render_bust
from solver.drawing.sheet import HEADER, Sheet
from solver.edits import DENSITY
from solver.fitting.face import Face, Pose
from solver.kinds.scene import STIFFNESS_PA
from solver.model import SubjectModel
from solver.rig.pictures import WIDTH
from solver.scene.places import check_objects
from solver.simulation import Simulator, Stepped
from solver.surface import Floats, Surface

FPS = 30.0
FRAMES = 20
"""Of one motion from its beginning to its end."""
PAST = 0.05
"""A jaw closes past the neutral by this part of its opening."""
GLASS_MM = (60.0, 26.0, 10.0)
PRESSED_MM = 8.0
GLASS_PRESSED_MM = 4.0
"""How far the headset and the glass go where the face was."""
APART_MM = 2.0
NEAR_MM = 0.01
OBJECT = np.array([0.10, 0.14, 0.20])
CELL = (WIDTH // 4, 400)


@dataclass(frozen=True)
class Scene:
    """Poses frame by frame, an object and its shifts (f, 3), and what a picture of the end shows.

    The object is pressed ``pressed_mm`` further than to where it first touches the neutral.
    ``centre`` (3,) and ``span`` are the camera's, ``cut`` is the x of a plane to cut at.
    """

    title: str
    poses: Sequence[Pose]
    thing: Surface | None
    shifts: Floats
    centre: Floats
    span: float
    cut: float
    pressed_mm: float | None = None

    def objects(self, frame: int) -> tuple[Surface, ...]:
        """Return the object where it is in a frame."""
        if self.thing is None:
            return ()
        return (self.thing.with_vertices(self.thing.vertices + self.shifts[frame]),)


@dataclass(frozen=True)
class Played:
    """A scene as it was played, frame by frame, with contact or without."""

    scene: Scene
    contact: bool
    steps: Sequence[Stepped]
    depths: Sequence[Penetration]


def scenes(person: Fitted) -> dict[str, Scene]:
    """Return the scenes by name."""
    model = person.model
    face = person.face()
    rest = face.rest_pose()
    skin = model.skin.vertices
    lips = np.concatenate([model.regions["upper_lip"], model.regions["lower_lip"]])
    lips = np.intersect1d(lips, model.embedded)
    middle = np.array([model.jaw.origin[0], skin[lips, 1].mean(), skin[lips, 2].max()])
    at_mouth = {"centre": middle - [0.0, 0.0, 15.0], "span": 95.0, "cut": middle[0]}
    still = np.zeros((3 * FRAMES, 3))

    def along(*poses: Pose) -> list[Pose]:
        parts = np.arange(1, FRAMES + 1) / FRAMES
        return [a.toward(b, part) for a, b in pairwise(poses) for part in parts]

    opened = person.blend("jawOpen")
    kissing = person.poses["kiss"]
    closed = Pose(rest.a, -PAST * opened.b)
    kissed = face.whole_skin(_moved(person, face, kissing), kissing.b)[lips, 2].max()
    box = trimesh.creation.box(GLASS_MM)
    glass = Surface(np.asarray(box.vertices), np.asarray(box.faces, np.int64))
    place = np.array([middle[0], middle[1], kissed + APART_MM + GLASS_MM[2] / 2])
    glass = glass.with_vertices(glass.vertices + place)
    pressed = np.zeros((2 * FRAMES, 3))
    pressed[FRAMES:, 2] = np.linspace(0.0, -APART_MM - GLASS_PRESSED_MM, FRAMES)
    worn = headset(model, APART_MM, PRESSED_MM)
    put_on = np.zeros((FRAMES, 3))
    put_on[:, 2] = np.linspace(0.0, -_gap(model, worn) - PRESSED_MM, FRAMES)
    eyes = skin[np.concatenate([model.regions["left_eyeball"], model.regions["right_eyeball"]])]
    at_eyes = {"centre": eyes.mean(axis=0), "span": 190.0, "cut": middle[0] + 40.0}
    return {
        "closing_jaw": Scene("jaw closes", along(rest, opened, closed), None, still, **at_mouth),
        "smile": Scene("smile", along(rest, person.poses["smile"]), None, still, **at_mouth),
        "pucker": Scene("pucker", along(rest, kissing), None, still, **at_mouth),
        "glass": Scene(
            "kiss on glass",
            along(rest, kissing, kissing),
            glass,
            pressed,
            **at_mouth,
            pressed_mm=GLASS_PRESSED_MM,
        ),
        "headset": Scene(
            "headset", [rest] * FRAMES, worn, put_on, **at_eyes, pressed_mm=PRESSED_MM
        ),
    }


def _gap(model: SubjectModel, thing: Surface) -> float:
    """Return how far a thing before the face may go back, in mm, until it touches the neutral."""
    faces = model.skin.faces
    skin = Surface(model.skin.vertices, faces[np.isin(faces, model.embedded).all(axis=1)])
    points = skin.vertices[model.embedded]
    free = 0.0
    touching = 2.0 * PRESSED_MM
    while touching - free > NEAR_MM:
        middle = (free + touching) / 2
        moved = thing.with_vertices(thing.vertices - [0.0, 0.0, middle])
        if max(depth_inside(points, moved), depth_inside(moved.vertices, skin)) > 0.0:
            touching = middle
        else:
            free = middle
    return free


def _moved(person: Fitted, face: Face, pose: Pose) -> Floats:
    """Return the vertices of a pose, without contact."""
    face = face.with_weights(person.S)
    return face.continuation(face.rest, pose).x


def play(person: Fitted, scene: Scene, *, contact: bool) -> Played:
    """Play a scene from the neutral."""
    face = person.face()
    gauge = Gauge(person.model)
    first = scene.objects(0)
    check_objects(person.model, {str(number): each for number, each in enumerate(first)})
    potentials = contact_potentials(person.model, STIFFNESS_PA, objects=first) if contact else []
    density = np.full(len(person.model.tets), DENSITY)
    simulator = Simulator(face, potentials, [], dynamic=False, density=density)
    before = person.drive(face, face.rest_pose(), 0.0)
    before = replace(before, objects=tuple(each.vertices for each in first))
    motion = simulator.rest(before)
    steps = []
    depths = []
    for frame, pose in enumerate(scene.poses):
        objects = scene.objects(frame)
        goal = person.drive(face, pose, (frame + 1) / FPS)
        goal = replace(goal, objects=tuple(each.vertices for each in objects))
        steps.append(simulator.step(motion, before, goal))
        motion = steps[-1].motion
        before = goal
        depths.append(gauge.at(steps[-1].y, pose.b, objects))
    return Played(scene, contact, steps, depths)


def play_all(person: Fitted) -> dict[str, tuple[Played, Played]]:
    """Play every scene without and with contact."""
    return {
        name: (play(person, scene, contact=False), play(person, scene, contact=True))
        for name, scene in scenes(person).items()
    }


def run(played: dict[str, tuple[Played, Played]]) -> Figures:
    """Return the figures of what :func:`play_all` has played."""
    return {
        name: {
            "pressed_mm": without.scene.pressed_mm,
            "without": measured(without),
            "with": measured(kept),
        }
        for name, (without, kept) in played.items()
    }


def measured(played: Played) -> Figures:
    """Return the figures of one scene."""
    depths = played.depths
    steps = played.steps
    return {
        "frames": len(steps),
        "penetration_max_mm": max(each.most for each in depths),
        "lips_mm": max(each.lips for each in depths),
        "teeth_mm": max(each.teeth for each in depths),
        "objects_mm": max(each.objects for each in depths),
        "behind_teeth": max(each.behind_teeth for each in depths),
        "inverted": max(each.inverted for each in steps),
        "frame_s": float(np.median([each.seconds for each in steps])),
        "halvings": sum(each.halvings for each in steps),
    }


def picture(path: Path, person: Fitted, played: dict[str, tuple[Played, Played]]) -> None:
    """Draw every scene's last frame without contact and with it: from outside, and cut open."""
    head = DrawnHead(person.model.skin)
    page = Sheet(WIDTH, HEADER + len(played) * CELL[1])
    page.heading("Contact", "Without, and with: the last frame from outside, and cut open")
    for row, pair in enumerate(played.values()):
        for column, each in enumerate(pair):
            views = _views(person, head, each)
            for number, (bodies, yaw) in enumerate(views):
                camera = Camera(each.scene.centre, each.scene.span, yaw)
                left = (2 * column + number) * CELL[0]
                page.panel((left, HEADER + row * CELL[1]), render_bust(bodies, camera, CELL))
            how = "with contact" if each.contact else "without"
            depth = max(found.most for found in each.depths)
            label = f"{each.scene.title}, {how}: {depth:.2f} mm"
            middle = (2 * column + 1) * CELL[0]
            page.text((middle, HEADER + (row + 1) * CELL[1] - 10), label, 20, anchor="ms")
    path.parent.mkdir(parents=True, exist_ok=True)
    page.save(path)


def _views(person: Fitted, head: DrawnHead, played: Played) -> list[tuple[list[DrawnBody], float]]:
    """Return the bodies and the camera's turn of a scene's end: whole, and cut open."""
    last = len(played.scene.poses) - 1
    skin = person.face().whole_skin(played.steps[-1].y, played.scene.poses[-1].b)
    lit = head.lit(skin)
    whole = [head.body(lit)]
    cut = [head.body(_cut(lit.surface, played.scene.cut))]
    for each in played.scene.objects(last):
        colour = np.tile(OBJECT, (len(each.vertices), 1))
        whole.append(DrawnBody(Lit(each), colour, opacity=0.35))
        cut.append(DrawnBody(_cut(each, played.scene.cut), colour, opacity=0.35))
    return [(whole, THREE_QUARTER), (cut, SIDE)]


def _cut(surface: Surface, x: float) -> Lit:
    """Return the part on the right of a sagittal plane, lit through the cut."""
    right = surface.vertices[surface.faces, 0].mean(axis=1) < x
    return Lit(Surface(surface.vertices, surface.faces[right]))
