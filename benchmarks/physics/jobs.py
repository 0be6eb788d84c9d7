"""Show 5: effects on a person as jobs of a service, as a studio asks for them.

The scenes of ``docs/examples/scenes`` in :data:`SCENES` are submitted for a rig of the service,
and what its job leaves is downloaded, pictures included. ``seconds`` are from submitting to the
end, ``change_percent`` is the flesh's volume: an edit's of the neutral, a motion's greatest of all
frames. ``drift_mm`` is how far expressions are from their poses, mean over the face and over the
expressions: an edit's from the unedited, a motion's at its keys from the same keys without forces,
head motion and inertia. ``moved_max_mm`` is how far a motion takes the flesh from its rest.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.documents import Figures
from myoface.client import Client
from myoface.resources import Rig
from solver.surface import Floats

FOLDER = Path(__file__).parents[2] / "docs" / "examples" / "scenes"
SCENES: Mapping[str, str] = {
    "fat": "edit",
    "slim": "edit",
    "chin_forward": "edit",
    "lip_filler": "edit",
    "palsy": "edit",
    "wind": "simulate",
    "jump": "simulate",
}
FORCES = ("forces", "head", "mode")
"""What a scene is without where only its keys count."""


def run(client: Client, rig: Rig, out: Path) -> Figures:
    """Run all scenes with a rig; what they leave goes into folders of ``out``."""
    figures = {}
    for name, kind in SCENES.items():
        scene = json.loads((FOLDER / f"{name}.json").read_text())
        begun = time.perf_counter()
        report = _made(client, rig, kind, scene, out / name)
        seconds = time.perf_counter() - begun
        if kind == "edit":
            found = edited(report)
        else:
            calm = {key: value for key, value in scene.items() if key not in FORCES}
            _made(client, rig, kind, calm, out / f"{name}-calm")
            held = [key["time"] for key in scene["keys"] if key.get("expressions")]
            drift = drifted(out / name, out / f"{name}-calm", held or [scene["duration"]])
            found = {**moved(report), "drift_mm": drift}
        figures[name] = {"seconds": round(seconds, 1), **found}
        logging.info("%s %s", name, figures[name])
    return figures


def edited(report: Mapping[str, Any]) -> Figures:
    """Return the figures of an ``edit.json``."""
    reached = [each for each in report["expressions"] if each["status"] == "found"]
    solved = [report["neutral"], *reached]
    return {
        "change_percent": report["volume"]["change_percent"],
        "drift_mm": float(np.mean([each["drift_mm"] for each in reached])),
        "penetration_mm": max(each["penetration_mm"] for each in solved),
        "inverted": max(each["inverted"] for each in solved),
    }


def moved(report: Mapping[str, Any]) -> Figures:
    """Return the figures of an ``animation.json``."""
    return {
        "change_percent": max(report["volume_change_percent"], key=abs),
        "penetration_mm": report["penetration_max_mm"],
        "inverted": report["inverted"],
        "behind_teeth": report["behind_teeth"],
        "moved_max_mm": report["moved_max_mm"],
    }


def drifted(forced: Path, calm: Path, times: list[float]) -> float:
    """Return the mean distance of two animations' faces at some times, seen from the head."""
    one, other = (_in_head(folder, times) for folder in (forced, calm))
    return float(np.linalg.norm(one - other, axis=-1).mean())


def _in_head(folder: Path, times: list[float]) -> Floats:
    """Return the face's points (times, points, 3) in the frames next to ``times``."""
    with np.load(folder / "animation.npz") as data:
        frames = [int(np.abs(data["time"] - time).argmin()) for time in times]
        turn = data["head"][frames, :3]
        shift = data["head"][frames, 3:]
        skin = data["skin"][frames].astype(np.float64) - shift[:, None]
    # a rotation vector's inverse
    turned = [Rotation.from_rotvec(-r).apply(s) for r, s in zip(turn, skin, strict=True)]
    return np.array(turned)


def _made(
    client: Client, rig: Rig, kind: str, scene: Mapping[str, Any], folder: Path
) -> Mapping[str, Any]:
    """Run one job to its end, download what it leaves, and return its report."""
    job = client.run(kind, rig.subject_id, rig_id=rig.id, options={"scene": scene})
    folder.mkdir(parents=True, exist_ok=True)
    assert job.result is not None
    for artifact in job.result.artifacts:
        client.download(artifact, folder / artifact.name)
    name = "edit.json" if kind == "edit" else "animation.json"
    report: Mapping[str, Any] = json.loads((folder / name).read_text())
    return report
