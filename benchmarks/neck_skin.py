"""Skin of a neck in extreme poses, simulated with the flesh above it.

A head goes through eight poses near the end of its range, joints sharing out its turns, and the
skin in each is compared with that at rest, on the built-in person and with ``--faces`` on one of
ICT-FaceKit. ``rim_mm``: how far the open rim moves; ``girth_change``: of lines around the neck, at
a fifth, two and three fifths of the way along its bodies; ``flipped``: triangles that look inward;
``area_ratio_p1``: the first percentile of the areas of triangles on the neck, by those at rest;
``seam_mm``: a step between skin on flesh and loose skin beside it; ``glb_mm``: how far
``animation.glb``, skinned by its joints, is off the simulation; ``chin_mm``: how far the lower lip
moves in a head thrown back by 40 degrees, the jaw still, with flesh that the neck draws and
without. ``off_is_off_mm``: a scene without a neck against that of the checkout ``--before``, if
that is given.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import report, subjects
from benchmarks.documents import Figures, Section, Table
from solver.anatomy.build import build_subject_model
from solver.animation import KeyedDrives
from solver.jobs.scenes import finish, play, skin_of
from solver.kinds.scene import SimulateScene
from solver.model import SubjectModel
from solver.neck.anatomy import JOINTS
from solver.neck.skin import NeckSkin
from solver.progress import silent
from solver.rig import Rig
from solver.rig.frames.animation import MotionRecord
from solver.scene import Stage
from solver.scene.document import drives_of
from solver.scene.places import Places
from solver.surface import Floats, Ints, area_normals, directed_edges
from solver.templates.builtin.build import builtin_template
from solver.templates.ict_facekit import ict_capture_set

POSES = {  # rotation vectors of the head, degrees: x looks down, y to the left, z to the right
    "left": (0.0, 60.0, 0.0),
    "right": (0.0, -60.0, 0.0),
    "down": (40.0, 0.0, 0.0),
    "up": (-40.0, 0.0, 0.0),
    "tilt_left": (0.0, 0.0, -30.0),
    "tilt_right": (0.0, 0.0, 30.0),
    "down_left": (20.0, 40.0, 10.0),
    "up_right": (-25.0, -40.0, -10.0),
}
Poses = Mapping[str, tuple[float, float, float]]
FRAMES = 4  # from pose to pose
LEVELS = (0.2, 0.4, 0.6)  # of the turns, where girths are measured
THROWN_BACK = 40.0  # degrees, for the chin


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    parser.add_argument("--model", type=Path, help="model.npz or rig.npz of another person")
    parser.add_argument("--before", type=Path, help="checkout of the code before necks")
    options = parser.parse_args()
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of all people."""
    poses = dict(list(POSES.items())[:2]) if options.quick else POSES
    people = {model.template["name"]: skin_figures(model, poses) for model in _models(options)}
    figures: Figures = {"people": people}
    if options.before:
        figures["off_is_off_mm"] = off_is_off(options.before)
    return figures


def _models(options: argparse.Namespace) -> list[SubjectModel]:
    if options.model:
        return [SubjectModel.load(options.model)]
    found = []
    for faces in dict.fromkeys([None, options.faces]):
        chosen = argparse.Namespace(**{**vars(options), "faces": faces})
        chosen.anatomy = faces and options.anatomy
        template = subjects.chosen_template(chosen, subjects.EDGE_MM)
        scan = template.skin
        if faces:
            scan = ict_capture_set(faces, options.subject, options.capture_sets).neutral
        edge = subjects.EDGE_MM
        found.append(build_subject_model(template, scan.vertices, edge_mm=edge, compartments=True))
    return found


@dataclass(frozen=True)
class Played:
    """A head's scene that was played: skins (f, V, 3) in the head's frame, and in the world."""

    stage: Stage
    frames: list[MotionRecord]
    own: Floats
    world: Floats
    report: dict[str, Any]

    @classmethod
    def of(cls, model: SubjectModel, poses: Poses, **neck: Any) -> Played:
        """Play ``poses`` one after the other, from rest, with the options of a ``neck``."""
        head: list[dict[str, Any]] = [{"time": 0.0}]
        for number, turn in enumerate(poses.values(), start=1):
            head.append({"time": float(number), "rotation_deg": list(turn)})
        scene = SimulateScene.model_validate(
            {
                "fps": FRAMES,
                "duration": len(poses),
                "head": head,
                "neck": {"muscles": False, **neck},
            }
        )
        places = Places(model, {})
        drives: KeyedDrives = drives_of(scene, {}, model, model.weights)
        stage = Stage(scene, places, model.weights, drives)
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder)
            frames = play(stage, out, "")
            finish(stage, frames, out, silent, title="Neck", video=False, more={})
            told = json.loads((out / "animation.json").read_text())
        own = np.array([skin_of(stage, frame) for frame in frames])
        pairs = zip(frames, own, strict=True)
        world = np.array([frame.into_world(skin) for frame, skin in pairs])
        return cls(stage, frames, own, world, told)

    @property
    def skin(self) -> NeckSkin:
        """Return the skin of the neck."""
        assert self.stage.neck is not None, "the scene has a neck"
        assert self.stage.neck.skin is not None, "its skin ends in a rim"
        return self.stage.neck.skin


def skin_figures(model: SubjectModel, poses: Poses = POSES) -> Figures:
    """Return the figures of a person's neck in ``poses``."""
    played = Played.of(model, poses)
    skin = played.skin
    rest = model.skin.vertices
    faces = model.skin.faces[(skin.places[model.skin.faces] < JOINTS).any(axis=1)]
    by_pose = {}
    for name, number in zip(poses, range(FRAMES, len(played.frames), FRAMES), strict=True):
        world = played.world[number]
        by_pose[name] = {
            "rim_mm": float(np.linalg.norm(world - rest, axis=1)[skin.rim].max()),
            "girth_change": girth_change(skin, world),
            "flipped": count_flipped(played, number, faces),
            "area_ratio_p1": float(np.percentile(area_ratios(rest, world, faces), 1)),
            "seam_mm": seam_mm(played, number),
        }
    worst = {
        name: (min if name == "area_ratio_p1" else max)(each[name] for each in by_pose.values())
        for name in ("rim_mm", "girth_change", "flipped", "area_ratio_p1", "seam_mm")
    }
    return {
        **{name: round(value, 5) for name, value in worst.items()},
        "glb_mm": played.report["glb"]["max_error_mm"],
        "chin_mm": chin_mm(model),
        "chin_uncoupled_mm": chin_mm(model, coupling=False),
        "inverted": played.report["inverted"],
        "halvings": played.report["halvings"],
        "frame_ms": played.report["frame_ms"],
        "neck": played.report["neck"],
        "poses": by_pose,
    }


def girth_change(skin: NeckSkin, world: Floats) -> float:
    """Return the greatest change of a girth in a skin (V, 3), as part of that at rest."""
    rest = skin.model.skin.vertices
    faces = skin.model.skin.faces
    changes = []
    for level in LEVELS:
        ends, parts = isoline(skin.places, faces, JOINTS * level)
        lengths = [
            float(np.linalg.norm(np.diff(_points(each, ends, parts), axis=1), axis=2).sum())
            for each in (rest, world)
        ]
        changes.append(abs(lengths[1] / lengths[0] - 1.0))
    return max(changes)


def isoline(values: Floats, faces: Ints, level: float) -> tuple[Ints, Floats]:
    """Return where a line of one value crosses triangles: sides (k, 2, 2), parts (k, 2) of them."""
    sides = directed_edges(faces).reshape(3, -1, 2).transpose(1, 0, 2)
    begin = values[sides[..., 0]] - level
    end = values[sides[..., 1]] - level
    crossed = (begin < 0.0) != (end < 0.0)
    through = crossed.sum(axis=1) == 2
    chosen = crossed[through]
    ends = sides[through][chosen].reshape(-1, 2, 2)
    part = (begin[through] / (begin[through] - end[through] + ~chosen))[chosen]
    return ends, part.reshape(-1, 2)


def _points(skin: Floats, ends: Ints, parts: Floats) -> Floats:
    begin = skin[ends[..., 0]]
    end = skin[ends[..., 1]]
    return np.asarray(begin + parts[..., None] * (end - begin))


def area_ratios(rest: Floats, world: Floats, faces: Ints) -> Floats:
    """Return the areas (f,) of triangles in a skin (V, 3), by those at rest."""
    areas = [np.linalg.norm(area_normals(each, faces), axis=1) for each in (world, rest)]
    return np.asarray(areas[0] / areas[1])


def count_flipped(played: Played, number: int, faces: Ints) -> int:
    """Return how many triangles look against the way in which the vertebrae turn them."""
    carried = played.stage.neck
    assert carried is not None, "the scene has a neck"
    matrices = carried.pose(played.frames[number].time).matrices
    turns = played.skin.blends(matrices, played.skin.places)[:, :3, :3][faces].mean(axis=1)
    rest = area_normals(played.stage.model.skin.vertices, faces)
    now = area_normals(played.world[number], faces)
    return int((np.einsum("fij,fj,fi->f", turns, rest, now) < 0.0).sum())


def seam_mm(played: Played, number: int) -> float:
    """Return how far loose skin parts from skin on flesh beside it, mm, at the worst.

    That is how much more the displacement from what the vertebrae do changes along an edge from
    skin on flesh to loose skin than along the edges that go on from there, to either side.
    """
    model = played.stage.model
    carried = played.stage.neck
    assert carried is not None, "the scene has a neck"
    hung = carried.hung(played.frames[number].time)
    assert hung is not None, "its skin follows"
    away = played.own[number] - hung.skin
    edges = directed_edges(model.skin.faces)
    steps = np.linalg.norm(away[edges[:, 0]] - away[edges[:, 1]], axis=1)
    on_flesh = np.isin(np.arange(len(away)), model.embedded)
    of_neck = (played.skin.places < JOINTS)[edges].any(axis=1)
    across = of_neck & (on_flesh[edges[:, 0]] != on_flesh[edges[:, 1]])
    along = np.zeros(len(away))  # the greatest change to a vertex of the same kind
    same = on_flesh[edges[:, 0]] == on_flesh[edges[:, 1]]
    np.maximum.at(along, edges[same].ravel(), np.repeat(steps[same], 2))
    beside = along[edges[across]].max(axis=1)
    return float(np.maximum(steps[across] - beside, 0.0).max(initial=0.0))


def chin_mm(model: SubjectModel, **neck: Any) -> float:
    """Return how far the lower lip moves in the head's frame in a head thrown back, mm."""
    lip = model.region("lower_lip")
    played = Played.of(model, {"up": (-THROWN_BACK, 0.0, 0.0)}, **neck)
    moved = np.linalg.norm(played.own[-1][lip] - model.skin.vertices[lip], axis=1)
    return round(float(moved.max(initial=0.0)), 4)


OFF = """
import sys
import numpy as np
from pathlib import Path
from solver.jobs import run_job
scene = {"fps": 10, "duration": 0.5, "keys": [{"time": 0}, {"time": 0.5, "jaw": {"open_deg": 10}}],
         "head": [{"time": 0}, {"time": 0.5, "rotation_deg": [10, 30, 5]}]}
rig, out = map(Path, sys.argv[1:])
run_job("simulate", out, options={"scene": scene}, rig=rig)
"""


def off_is_off(before: Path) -> float:
    """Return how far a scene without a neck is off that of another checkout, mm, at the worst."""
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder) / "rig.npz"
        template = subjects.chosen_template(subjects.builtin_options(), subjects.EDGE_MM)
        model = build_subject_model(template, builtin_template().skin.vertices)
        Rig(model, model.weights, ()).save(rig)
        skins = list[Floats]()
        for code in (Path(__file__).parents[1], before):
            out = Path(folder) / f"{len(skins)}"
            out.mkdir()
            environment = os.environ | {"PYTHONPATH": str(code), "OMP_NUM_THREADS": "1"}
            command = [sys.executable, "-c", OFF, str(rig), str(out)]
            subprocess.run(command, env=environment, cwd=code, check=True)
            with np.load(out / "animation.npz") as data:
                skins.append(data["skin"].astype(np.float64))
    return float(np.abs(skins[0] - skins[1]).max())


def section(figures: Figures) -> Section:
    """Return the section of the document."""
    names = (
        *("rim_mm", "girth_change", "flipped", "area_ratio_p1", "seam_mm", "glb_mm"),
        *("chin_mm", "chin_uncoupled_mm", "inverted"),
    )
    people = figures["people"]
    rows = [[name, *(people[person][name] for person in people)] for name in names]
    compared = (
        "The skin of a neck, and the flesh that it draws, in eight poses near the end of its range "
        "(60 degrees to either side, 40 down and up, 30 of tilt, and two mixed ones), against rest."
    )
    return Section("Skin of a neck", compared, [Table(["figure", *people], rows)])


if __name__ == "__main__":
    main()
