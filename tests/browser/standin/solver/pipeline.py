"""A pipeline that solves nothing, but tells its progress and leaves pictures as the real one does.

A scan's lines ``#! key value`` say what happens: ``seconds`` to take, ``verdict`` to get, ``fault``
to have, ``view`` for a rig that can be looked at.
"""

import base64
import json
import os
import time
from pathlib import Path
from typing import NamedTuple

from PIL import Image, ImageDraw

from solver.errors import InputError
from solver.progress import Step

FINDING = {
    "code": "scan.no_mouth",
    "severity": "error",
    "message": "there are no points around the mouth: 41 mm are missing",
    "advice": "turn the head towards the lower camera and scan again",
}


def check_scan(scan, out, *, template=None, landmarks=None, options=None, progress):
    _work([scan], progress, ["read", "check", "pictures"])
    verdict = _orders(scan).get("verdict", "good")
    findings = {
        "good": [],
        "usable": [FINDING | {"severity": "warning", "message": "the left ear is thin"}],
        "bad": [FINDING],
    }[verdict]
    figures = {"vertices": 48312, "height_mm": 231.4, "holes": len(findings)}
    check = {"verdict": verdict, "findings": findings, "figures": figures}
    (out / "check.json").write_text(json.dumps(check))
    _picture(out / "check.png", scan.name)


def register_scan(
    scan, out, *, template=None, neutral=None, landmarks=None, options=None, progress
):
    _work([scan], progress, ["read", "pose", "shape", "free form"])
    (out / "registered.ply").write_bytes(b"ply")
    figures = {"mean_mm": 0.31, "p95_mm": 0.9, "coverage": 0.83, "findings": []}
    (out / "registration.json").write_text(json.dumps(figures))
    _picture(out / "distance.png", scan.name)


def build_model(neutral, out, *, template=None, options=None, progress):
    _work([neutral], progress, ["mesh", "relax", "muscles"])
    (out / "model.npz").write_bytes(b"model")
    (out / "model.json").write_text(json.dumps({"tets": 24816, "muscles": 43}))
    _picture(out / "anatomy.png", neutral.name)


def fit_geometry(model, captures, out, *, options=None, progress):
    _work(captures.values(), progress, ["geometry", "activations", "export"])
    (out / "rig.glb").write_bytes(b"glTF" + bytes(4096))
    (out / "activations.npz").write_text("{}")
    (out / "muscle_weights.npz").write_bytes(b"S")
    report = {"expressions": {name: {} for name in captures}, "train_mean_mm": 0.42}
    if any("view" in _orders(scan) for scan in captures.values()):
        from tests.browser.sample_rig import write_sample  # needs seconds, so only here

        report |= write_sample(out).summary()
    (out / "report.json").write_text(json.dumps(report))
    (out / "report.html").write_text("<!doctype html><title>Report</title><h1>Report</h1>")


class PersonFiles(NamedTuple):
    model: Path
    weights: Path
    rig: Path
    assets: dict[str, Path]
    template: Path | None


def simulate(person, out, *, resume=False, options=None, progress):
    """Leave a frame with a picture, a file each, until the scene's ``duration`` in s is over."""
    folder = out / "frames"
    folder.mkdir()
    total = int(10 * options["scene"]["duration"])
    for number in range(total):
        _picture(out / "newest.png", f"frame {number}")
        picture = base64.b64encode((out / "newest.png").read_bytes()).decode()
        partial = folder / "partial"
        partial.write_text(json.dumps({"frames": [], "picture": picture}))
        partial.rename(folder / f"{number:06d}-{number:06d}.json")
        words = f"frame {number + 1} of {total}"
        progress(Step("simulate", number / total, number + 1, message=words))
        time.sleep(0.1)
    (out / "newest.png").rename(out / "animation.png")
    figures = {"frames": total, "penetration_max_mm": 0.12, "frame_ms": 410.0}
    (out / "animation.json").write_text(json.dumps(figures))


def _work(scans, progress, phases):
    """Report progress in ``phases``, with an error that falls, for as long as the scans say."""
    orders = [_orders(scan) for scan in scans]
    seconds = sum(float(order.get("seconds", 0.5)) for order in orders)
    reports = max(12, int(seconds / 0.2))
    for number in range(reports):
        part = number / reports
        progress(
            Step(
                phases[int(part * len(phases))],
                part,
                iteration=number + 1,
                residual=40 * 0.8 ** min(number, 60),
                mean_error_mm=0.3 + 2.4 * 0.88**number,
            )
        )
        os.write(1, f"iteration {number + 1:3d}  objective {40 * 0.8**number:.4e}\n".encode())
        time.sleep(seconds / reports)
    for scan, order in zip(scans, orders, strict=True):
        if order.get("fault") == "nan":
            raise InputError(
                "scan.nan", f"{scan.name} has a value that is not a number in line 3", line=3
            )


def _picture(path, words):
    image = Image.new("RGB", (480, 320), "#20262b")
    draw = ImageDraw.Draw(image)
    draw.ellipse((170, 40, 310, 260), fill="#b8a79a")
    draw.text((12, 296), words, fill="#e8ecee")
    image.save(path)


def _orders(scan):
    lines = Path(scan).read_text().splitlines()
    return dict(line[3:].split(maxsplit=1) for line in lines if line.startswith("#! "))
