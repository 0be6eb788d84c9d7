"""A pipeline that solves nothing: what it does is written in the scans it is given.

A scan's lines ``#! key value`` say it: ``seconds`` to take, ``fault`` to have, seconds for
which a ``child`` process sleeps.
"""

import base64
import json
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

from solver.errors import InputError
from solver.progress import Step


def check_scan(scan, out, *, template=None, landmarks=None, options=None, progress):
    _work([scan], progress)
    verdict = dict(_orders(scan)).get("verdict", "good")
    faults = ["mouth"] if verdict == "bad" else []
    findings = [
        {
            "code": f"scan.{fault}",
            "severity": "error",
            "message": f"{scan} has no {fault}",
            "advice": f"scan again with the {fault} in view",
        }
        for fault in faults
    ]
    figures = {"landmarks": landmarks and landmarks.read_text(), "options": options}
    check = {"verdict": verdict, "findings": findings, "figures": figures}
    (out / "check.json").write_text(json.dumps(check))
    (out / "check.png").write_bytes(b"PNG")


def register_scan(
    scan, out, *, template=None, neutral=None, landmarks=None, options=None, progress
):
    _work([scan], progress)
    mesh = b"registered " + scan.read_bytes()
    for more in (landmarks, neutral):
        mesh += b" by " + more.read_bytes() if more else b""
    (out / "registered.ply").write_bytes(mesh)
    figures = {"mean_mm": 0.3, "coverage": 0.8, "findings": []}
    figures["neutral"] = neutral and neutral.name
    (out / "registration.json").write_text(json.dumps(figures))
    (out / "distance.png").write_bytes(b"PNG")


def build_model(neutral, out, *, template=None, options=None, progress):
    _work([neutral], progress)
    (out / "model.npz").write_bytes(b"model of " + neutral.read_bytes())
    (out / "model.json").write_text(json.dumps({"template": template and template.name}))


def fit_geometry(model, captures, out, *, options=None, progress):
    assert model.read_bytes().startswith(b"model of")
    _work(captures.values(), progress)
    _leave_rig(out, list(captures))


def fit_activations(model, weights, captures, out, *, rig=None, options=None, progress):
    assert weights.name == "muscle_weights.npz"
    _work(captures.values(), progress)
    _leave_rig(out, [*json.loads(rig.read_text()), *captures])


def fit_sequence(model, weights, performance, out, *, resume=False, options=None, progress):
    """Leave frames, two a file, as the orders say: ``frames`` in all, ``seconds`` for each."""
    orders = dict(_orders(performance))
    folder = out / "frames"
    assert resume == folder.exists()
    folder.mkdir(exist_ok=True)
    done = 2 * len(list(folder.iterdir()))
    for first in range(done, int(orders["frames"]), 2):
        time.sleep(float(orders.get("seconds", 0)))
        frames = [FRAME | {"frame": number, "iterations": done} for number in (first, first + 1)]
        partial = folder / "partial"
        partial.write_text(json.dumps({"frames": frames}))
        partial.rename(folder / f"{first:06d}-{first + 1:06d}.json")
        progress(Step("frames", first / int(orders["frames"]), first + 2))
        if first == 2 and not resume:
            _fail(orders.get("fault"), performance)
    (out / "sequence.npz").write_bytes(b"PK")
    (out / "sequence.json").write_text(json.dumps({"frames": int(orders["frames"])}))


def build_preview(model, weights, rig, out, *, options=None, progress):
    assert (model.name, weights.name) == ("model.npz", "muscle_weights.npz")
    presets = json.loads(rig.read_text())
    progress(Step("simulate", 0.5))
    (out / "preview.bin").write_bytes(b"MYOV" + json.dumps([presets, options]).encode())
    (out / "preview.json").write_text(json.dumps({"controls": 3}))


class PersonFiles(NamedTuple):
    model: Path
    weights: Path
    rig: Path
    assets: dict[str, Path]
    template: Path | None


def simulate(person, out, *, resume=False, options=None, progress):
    """Leave frames of a scene, two a file; the scene's ``damping`` is the time for each, s."""
    assert (person.model.name, person.weights.name) == ("model.npz", "muscle_weights.npz")
    scene = options["scene"]
    folder = out / "frames"
    folder.mkdir(exist_ok=True)
    total = int(scene["duration"] * scene["fps"])
    for first in range(2 * len(list(folder.iterdir())), total, 2):
        time.sleep(scene.get("damping", 0))
        frames = [MOTION | {"frame": number, "time": number / 30} for number in (first, first + 1)]
        picture = base64.b64encode(b"JPEG of %d" % first).decode() if first % 4 == 0 else None
        partial = folder / "partial"
        partial.write_text(json.dumps({"frames": frames, "state": {}, "picture": picture}))
        partial.rename(folder / f"{first:06d}-{first + 1:06d}.json")
        progress(Step("simulate", first / total, first + 2))
    figures = {"frames": total, "assets": {name: path.name for name, path in person.assets.items()}}
    (out / "animation.json").write_text(json.dumps(figures))
    (out / "animation.mp4").write_bytes(b"film")


def animate(person, out, *, blendshapes=None, resume=False, options=None, progress):
    figures = {"blendshapes": blendshapes and blendshapes.read_text()}
    (out / "blendshapes.npz").write_text("solved")
    (out / "animation.json").write_text(json.dumps(figures))


def edit(person, out, *, options=None, progress):
    (out / "edit.json").write_text(json.dumps({"edits": len(options["scene"]["edits"])}))


MOTION = {
    "activations": [[1, 0, 0, 1, 0, 1]],
    "jaw": [0] * 5,
    "head": [0] * 6,
    "eyes": [[0, 0, 0], [0, 0, 0]],
    "penetration_mm": 0.1,
    "behind_teeth": 0,
    "inverted": 0,
    "iterations": 3,
    "halvings": 0,
    "residual": 1e-6,
    "seconds": 0.1,
    "x": "eJwDAAAAAAE=",
}

FRAME = {
    "status": "fitted",
    "activations": [[1, 0, 0, 1, 0, 1]],
    "jaw": [0] * 5,
    "head": [0] * 6,
    "mean_mm": 0.25,
    "p95_mm": 0.5,
    "max_mm": None,
    "coverage": 1,
    "inverted": 0,
    "seconds": 0.1,
}


def _leave_rig(out, expressions):
    (out / "rig.glb").write_bytes(b"glTF" + os.urandom(4096))
    (out / "activations.npz").write_text(json.dumps(expressions))
    (out / "muscle_weights.npz").write_bytes(b"S")
    report = {"expressions": {name: {} for name in expressions}, "train_mean_mm": 0.4}
    (out / "report.json").write_text(json.dumps(report))
    (out / "report.html").write_text("<p>good</p>")


def _work(scans, progress):
    for scan in scans:
        orders = dict(_orders(scan))
        if "child" in orders:
            subprocess.Popen(["sleep", orders["child"]])
        seconds = float(orders.get("seconds", 0))
        for step in range(max(1, int(seconds / 0.1))):
            progress(Step("geometry", 0.1 * step / max(seconds, 1), step, residual=float("nan")))
            os.write(1, f"step {step} of {scan.name}\n".encode())
            time.sleep(min(seconds, 0.1))
        _fail(orders.get("fault"), scan)


def _fail(fault, scan):
    if fault == "nan":
        raise InputError("scan.nan", f"{scan} has a NaN in line 3", file=str(scan), line=3)
    if fault == "crash":
        raise ZeroDivisionError("a bug")
    if fault == "memory":
        bytearray(1 << 36)
    if fault == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if fault == "deaf":  # a C library that hears no signal
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(120)
    if fault == "poison":
        os.kill(os.getppid(), signal.SIGKILL)


def _orders(scan):
    for line in scan.read_text().splitlines():
        if line.startswith("#! "):
            yield line[3:].split()
