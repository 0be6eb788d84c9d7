"""A fitted take in scenes: a rod held by the lips, a ball on the cheek, exaggerated, a palsy.

    python -m benchmarks.take_scenes --rig rig.npz --sequence sequence.npz -o OUT --json -

The scenes are those of ``docs/examples/scenes``. ``slip_mm`` is how far skin that touches the rod
moves along it, from where it came to touch, at the worst point and in the median; ``near_mm`` is
what counts as touching. ``activations_changed`` are entries that are not what was fitted, to the
digits that fits are stored with, where it is played so. ``motion_ratio`` is the face's motion in
its head over that of the take as it was fitted.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import igl
import numpy as np

from benchmarks import report
from benchmarks.documents import Figures, Section, Table
from solver.jobs import run_job
from solver.kinds.scene import PerformanceEntry, SimulateScene
from solver.model import SubjectModel
from solver.rig import Rig
from solver.scene.document import read_scene
from solver.scene.places import Places, SceneObject, objects_of
from solver.similarity import small_motion
from solver.surface import Floats

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples" / "scenes"
SCENES = {
    "fitted": "",
    "rod": "take_with_rod",
    "ball": "take_with_ball",
    "twice": "take_twice",
    "four_times": "take_four_times",
    "palsy": "take_palsy",
}
NEAR_MM = 0.15  # contact acts from 0.14 mm on: 0.08 of barrier, 0.06 that it lies under the skin
STORED = 1e-9  # what digits of a stored activation say
COLUMNS = ("penetration_mm", "inverted", "behind_teeth", "frame_ms", "motion_ratio")


def main() -> None:
    """Play the scenes and write their figures."""
    parser = report.parser(__doc__)
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--sequence", type=Path, required=True, help="of the rig's person")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for the animations")
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--only", nargs="*", choices=SCENES, default=list(SCENES))
    parser.add_argument("--scene", type=json.loads, default={}, help="JSON over each scene's own")
    options = parser.parse_args()
    rig = Rig.load({"rig": options.rig})
    figures: Figures = {"near_mm": NEAR_MM, "scene": {}}
    for name in options.only:
        document = _scene(SCENES[name], options.fps) | options.scene
        out = options.out / name
        run_job(
            "simulate",
            out,
            options={"scene": document},
            captures={"take": options.sequence},
            rig=options.rig,
        )
        scene = read_scene(document, SimulateScene)
        figures["scene"][name] = _measure(out, rig.model, scene, options.sequence)
    fitted = figures["scene"].get("fitted")
    for found in figures["scene"].values():
        found["motion_ratio"] = found["motion_mm"] / fitted["motion_mm"] if fitted else None
    report.finish(figures, options, section)


def section(figures: dict[str, Any]) -> Section:
    """Return the section of the document."""
    rows = [[name, *(row[each] for each in COLUMNS)] for name, row in figures["scene"].items()]
    rod = figures["scene"].get("rod", {})
    slip = f"Lips slip {rod['slip_mm']:.2f} mm along the rod at most. " if rod else ""
    return Section(
        title="Takes in scenes",
        compared=f"{slip}A fitted take, played in the example scenes.",
        parts=[Table(["scene", *COLUMNS], rows)],
    )


def _scene(example: str, fps: float) -> dict[str, Any]:
    if not example:
        return {"fps": fps, "performance": {"asset": "take"}}
    document: dict[str, Any] = json.loads((EXAMPLES / f"{example}.json").read_text("utf-8"))
    return {**document, "fps": fps}


def _measure(
    out: Path, model: SubjectModel, scene: SimulateScene, sequence: Path
) -> dict[str, Any]:
    """Return the figures of an animation."""
    told = json.loads((out / "animation.json").read_text(encoding="utf-8"))
    with np.load(out / "animation.npz") as data, np.load(sequence) as take:
        times = data["time"]
        skins = data["skin"].astype(np.float64)
        heads = data["head"]
        played = data["activations"].reshape(len(times), -1)
        given = take["activations"].reshape(len(take["time"]), -1)
        begun = take["time"] - take["time"][0]
    same = np.flatnonzero(np.abs(begun[:, None] - times).min(axis=1) < 1e-6)
    frames = np.abs(times[:, None] - begun[same]).argmin(axis=0)
    changed = np.abs(played[frames] - given[same])
    entry = scene.performance
    as_fitted = isinstance(entry, PerformanceEntry) and entry.gain == entry.speed == 1.0
    local = np.array([small_motion(h).inverse()(s) for h, s in zip(heads, skins, strict=True)])
    moved = np.linalg.norm(local - model.skin.vertices[model.face], axis=2)
    objects = objects_of(scene.objects, Places(model, _landmarks(model)), scene.interpolation)
    slips = _slips(times, skins, objects[0]) if objects else np.zeros(0)
    return {
        "frames": told["frames"],
        "penetration_mm": told["penetration_max_mm"],
        "inverted": told["inverted"],
        "behind_teeth": told["behind_teeth"],
        "halvings": told["halvings"],
        "frame_ms": told["frame_ms"],
        "activations_changed": int((changed > STORED).sum()) if as_fitted else None,
        "motion_mm": float(moved.mean()),
        "slip_mm": float(slips.max()) if len(slips) else None,
        "slip_median_mm": float(np.median(slips)) if len(slips) else None,
        "touched": len(slips),
    }


def _landmarks(model: SubjectModel) -> dict[str, int]:
    return dict(Places.of(model, None, {}).landmarks)


def _slips(times: Floats, skins: Floats, thing: SceneObject) -> Floats:
    """Return how far each point that touches a resting ``thing`` moves along it, mm."""
    moves = np.array([thing.path(float(time)) for time in times])
    resting = np.flatnonzero(np.abs(moves - moves[-1]).max(axis=1) < 1e-9)
    surface = thing.at(float(times[-1]))
    slipped: dict[int, list[float]] = {}
    came: dict[int, Floats] = {}
    for frame in resting:
        squared, triangles, _ = igl.point_mesh_squared_distance(
            skins[frame], surface.vertices, surface.faces
        )[:3]
        touching = set(np.flatnonzero(squared < NEAR_MM**2).tolist())
        corners = surface.vertices[surface.faces[triangles]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        for point in touching:
            place = skins[frame, point]
            normal = normals[point] / np.linalg.norm(normals[point])
            away = place - came.setdefault(point, place)
            slipped.setdefault(point, []).append(
                float(np.linalg.norm(away - (away @ normal) * normal))
            )
        came = {point: place for point, place in came.items() if point in touching}
    return np.array([max(each) for each in slipped.values()])


if __name__ == "__main__":
    main()
